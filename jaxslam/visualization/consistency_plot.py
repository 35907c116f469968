"""Picture of the errors of poses beside the covariances that were given out with them."""

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jaxslam.errors import TrajectoryError
from jaxslam.io.atomic_files import write_atomically
from jaxslam.trajectory.consistency import Consistency
from jaxslam.visualization.plots import png, with_breaks

_CONSISTENT = (0.5, 2.0)
"""Mean NEES of covariances that are right within a factor of two."""


def plot_consistency(consistency: Consistency, path: Path, *, title: str = "") -> None:
    """Write one picture over time: errors of translation and rotation with their standard deviations, and the NEES.

    Args:
        consistency: Errors and covariances.
        path: File of the picture, a PNG.
        title: Line above the picture; empty for none.

    Raises:
        TrajectoryError: If the file cannot be written.
    """
    figure = Figure(figsize=(8, 7), layout="constrained")
    translation, rotation, nees = figure.subplots(3, sharex=True)
    stamps = consistency.timestamps_ns
    columns = (
        (stamps - stamps[0]) / 1e9,
        consistency.nees_of_pose,
        *(1e3 * consistency.translation_error_m, 1e3 * consistency.translation_sigma_m),
        *(consistency.rotation_error_deg, consistency.rotation_sigma_deg),
    )
    seconds, nees_of_pose, *errors = with_breaks(stamps, np.column_stack(columns)).T
    _draw_errors(translation, seconds, *errors[:2], label="translation [mm]")
    _draw_errors(rotation, seconds, *errors[2:], label="rotation [deg]")
    nees.plot(seconds, nees_of_pose, color="tab:blue", label="NEES of a pose")
    nees.axhline(consistency.nees, color="0.3", linestyle="--", linewidth=0.8, label=f"mean {consistency.nees:.2f}")
    nees.axhspan(*_CONSISTENT, color="tab:green", alpha=0.2, linewidth=0, label="consistent within a factor of 2")
    nees.set(yscale="log", xlabel="time [s]", ylabel="NEES")
    for axes in (translation, rotation, nees):
        axes.margins(x=0)
        axes.grid(alpha=0.3)
        axes.legend(fontsize=8)
    above = f"{title}\n" if title else ""
    figure.suptitle(f"{above}{consistency}", fontsize=8, family="monospace", x=0.02, ha="left", wrap=True)
    write_atomically(path, png(figure), TrajectoryError)


def _draw_errors(axes: Axes, seconds: np.ndarray, error: np.ndarray, sigma: np.ndarray, label: str) -> None:
    """Draw errors over time above the area within one and two standard deviations."""
    for times, alpha in ((2, 0.15), (1, 0.25)):
        axes.fill_between(seconds, times * sigma, color="tab:orange", alpha=alpha, linewidth=0, label=f"{times} sigma")
    axes.plot(seconds, error, color="tab:blue", label="error")
    axes.set_ylabel(label)
    axes.set_ylim(bottom=0)
