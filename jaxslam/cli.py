"""The command line: `jaxslam demo`, `run`, `compare`, `bench`, `eval`, `doctor`, `export`, `models`, `data`."""

import logging
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro
from rich.console import Console

from jaxslam.bench_command import Bench
from jaxslam.compare_command import Compare
from jaxslam.data_command import Data
from jaxslam.doctor import diagnose
from jaxslam.errors import ConfigError, DatasetError, JaxSlamError
from jaxslam.evaluation import evaluate
from jaxslam.map_export import write_colmap, write_keyframe_trajectory, write_ply
from jaxslam.map_file import load_map
from jaxslam.models_command import Models
from jaxslam.run_command import Demo, Run
from jaxslam.trajectory import read
from jaxslam.visualize import plot_trajectory

_console = Console(soft_wrap=True)


@dataclass(frozen=True)
class Eval:
    """Compare an estimated trajectory with the truth: ATE and RPE. Formats (TUM, KITTI) are recognised."""

    estimate: tyro.conf.Positional[Path]
    """The estimate."""
    groundtruth: tyro.conf.Positional[Path]
    """The truth."""
    align: Literal["se3", "sim3", "none"] = "se3"
    """What to fit before comparing positions."""
    max_gap: float = 0.02
    """Poses further apart in time than this do not match, seconds."""
    plot: Path | None = None
    """Also draw both to this PNG."""

    def main(self) -> None:
        """Run the command."""
        estimate, truth = read(self.estimate), read(self.groundtruth)
        evaluation = evaluate(estimate, truth, align=self.align, max_gap_s=self.max_gap)
        _console.print(str(evaluation), highlight=False)
        if self.plot is not None:
            plot_trajectory(estimate, truth, evaluation, self.plot)
            _console.print(f"Plot: {self.plot}")


@dataclass(frozen=True)
class Doctor:
    """Look a recording over before tracking it: files, times, calibration, depth scale, picture quality."""

    recording: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="PATH")]
    """Folder of the recording."""
    dataset: str = "auto"
    """Kind of the recording: auto, tum, bonn."""
    camera: str | None = None
    """Known camera or camera file."""

    def main(self) -> None:
        """Run the command."""
        diagnosis = diagnose(self.recording, self.dataset, self.camera)
        _console.print(str(diagnosis), highlight=False, markup=False)
        if not diagnosis.ok:
            raise DatasetError(f"{self.recording}: not fit to be tracked, see above")


@dataclass(frozen=True)
class Export:
    """Write a map for other programs: points as PLY, all of it as a COLMAP model, keyframes as a trajectory."""

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
        _console.print(
            f"{len(map.ids)} keyframes, {len(map.points.ids)} points: {', '.join(str(path) for path in wanted)}"
        )


def main(arguments: Sequence[str] | None = None) -> None:
    """The `jaxslam` command: known errors are one line and exit code 1."""
    logging.basicConfig(level=logging.WARNING, format="%(levelname)s: %(message)s")
    command: Any = tyro.cli(
        Demo | Run | Compare | Bench | Eval | Doctor | Export | Models | Data,
        prog="jaxslam",
        args=arguments,
        description=_DESCRIPTION,
    )
    try:
        command.main()
    except JaxSlamError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(1)
    except KeyboardInterrupt:
        print("error: interrupted", file=sys.stderr)
        sys.exit(130)


_DESCRIPTION = "Real-time visual SLAM for dynamic scenes. Start with: jaxslam demo"
