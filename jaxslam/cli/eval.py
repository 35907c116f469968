"""`jaxslam eval`: an estimated trajectory against the truth."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import tyro

from jaxslam.cli.console import plain_console, print_json
from jaxslam.cli.shared_options import WithJson


@dataclass(frozen=True)
class Eval(WithJson):
    """Options of `jaxslam eval`."""

    estimate: tyro.conf.Positional[Path]
    """The estimate."""
    groundtruth: tyro.conf.Positional[Path]
    """The truth."""
    align: Literal["se3", "sim3", "none"] = "se3"
    """What to fit before comparing positions."""
    max_gap: float = 0.02
    """Poses further apart in time than this do not match, seconds."""
    time_offset: float | Literal["auto"] = 0.0
    """Seconds to add to the stamps of the estimate; auto finds the offset of least ATE, up to a second."""
    times: tuple[Path, ...] = ()
    """Stamps of rows of KITTI, one a line: a file for either or both sides, or one for each."""
    frames: Path | None = None
    """Frames of the recording, for the coverage: rgb.txt of TUM or a stamp a line; else found beside the truth."""
    plot: Path | None = None
    """Also draw both to this file: .png, .pdf or .svg."""

    def main(self) -> None:
        """Run the command."""
        from jaxslam.datasets.evaluation_files import read_pair  # noqa: PLC0415
        from jaxslam.trajectory.evaluation import evaluate  # noqa: PLC0415 - not for `--help`
        from jaxslam.visualization.plots import picture_format, plot_trajectory  # noqa: PLC0415

        if self.plot is not None:
            picture_format(self.plot)  # an error now, not after the figures
        pair = read_pair(self.estimate, self.groundtruth, self.times, self.frames)
        evaluation = evaluate(
            pair.estimate,
            pair.reference,
            align=self.align,
            max_gap_s=self.max_gap,
            frames_ns=pair.frames_ns,
            time_offset_s=self.time_offset,
        )
        evaluation = replace(evaluation, notes=pair.notes + evaluation.notes)
        if self.json:
            print_json(evaluation.summary())
        else:
            plain_console.print(str(evaluation))
        if self.plot is not None:
            plot_trajectory(pair.estimate, pair.reference, evaluation, self.plot)
            plain_console.print(f"Plot: {self.plot}")
