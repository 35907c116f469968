"""`jaxslam export`: a map for other programs."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from jaxslam.commands.console import console, print_json
from jaxslam.commands.settings import WithJson
from jaxslam.errors import ConfigError


@dataclass(frozen=True)
class Export(WithJson):
    """Options of `jaxslam export`."""

    map: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="MAP")]
    """Map file, as `run --save-map` writes it."""
    ply: Path | None = None
    """PLY file for the points and keyframes."""
    colmap: Path | None = None
    """Folder for a COLMAP text model with its images."""
    trajectory: Path | None = None
    """TUM file for the poses of the keyframes."""

    def main(self) -> None:
        """Run the command."""
        from jaxslam.map_export import write_colmap, write_keyframe_trajectory, write_ply  # noqa: PLC0415 - not for `--help`
        from jaxslam.map_file import load_map  # noqa: PLC0415

        map = load_map(self.map)
        wanted = [path for path in (self.ply, self.colmap, self.trajectory) if path is not None]
        if not wanted:
            raise ConfigError("export: expected at least one of --ply FILE, --colmap FOLDER, --trajectory FILE")
        if self.ply is not None:
            write_ply(self.ply, map, keyframes=True)
        if self.colmap is not None:
            write_colmap(self.colmap, map)
        if self.trajectory is not None:
            write_keyframe_trajectory(self.trajectory, map)
        keyframes, points, paths = len(map.ids), len(map.points.ids), [str(path) for path in wanted]
        if self.json:
            print_json({"keyframes": keyframes, "map_points": points, "files": paths})
        else:
            console.print(f"{keyframes} keyframes, {points} points: {', '.join(paths)}")
