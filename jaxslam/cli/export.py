"""`jaxslam export`: a map for other programs."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from jaxslam.cli.console import console, print_json
from jaxslam.cli.shared_options import WithJson
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
    submap: int | None = None
    """Submap to export, where the map has several, each in a world of its own; by default that with most keyframes."""

    def main(self) -> None:
        """Run the command."""
        from jaxslam.map.export import (  # noqa: PLC0415 - not for `--help`
            one_submap,
            write_colmap,
            write_keyframe_trajectory,
            write_ply,
        )
        from jaxslam.map.npz_file import load_map  # noqa: PLC0415

        whole = load_map(self.map)
        wanted = [path for path in (self.ply, self.colmap, self.trajectory) if path is not None]
        if not wanted:
            raise ConfigError("export: expected at least one of --ply FILE, --colmap FOLDER, --trajectory FILE")
        slam_map = one_submap(whole, self.submap)
        if self.ply is not None:
            write_ply(self.ply, slam_map, keyframes=True)
        if self.colmap is not None:
            write_colmap(self.colmap, slam_map)
        if self.trajectory is not None:
            write_keyframe_trajectory(self.trajectory, slam_map)
        keyframes, points, paths = len(slam_map.ids), len(slam_map.points.ids), [str(path) for path in wanted]
        others = sorted({*whole.submap.tolist()} - {*slam_map.submap.tolist()})
        if self.json:
            figures = {"submap": slam_map.world_submap, "other_submaps": others}
            print_json(figures | {"keyframes": keyframes, "map_points": points, "files": paths})
            return
        console.print(f"{keyframes} keyframes, {points} points: {', '.join(paths)}")
        if others:
            console.print(
                f"Submap {slam_map.world_submap}; left out, each in a world of its own: submaps {others} (--submap N)"
            )
