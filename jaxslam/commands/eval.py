"""`jaxslam eval`: an estimated trajectory against the truth."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

from jaxslam.commands.console import console
from jaxslam.evaluation import evaluate
from jaxslam.trajectory import read
from jaxslam.visualize import plot_trajectory


@dataclass(frozen=True)
class Eval:
    """Compare an estimated trajectory with the truth: ATE, RPE, and KITTI's t_rel and r_rel if it is 100 m long.

    Formats (TUM, KITTI) are recognised.
    """

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
        console.print(str(evaluation), highlight=False)
        if self.plot is not None:
            plot_trajectory(estimate, truth, evaluation, self.plot)
            console.print(f"Plot: {self.plot}")
