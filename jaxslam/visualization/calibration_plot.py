"""Picture of the residuals of held-out frames before and after a calibration."""

from itertools import pairwise
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jaxslam.calibration.report import Calibration
from jaxslam.errors import CameraError
from jaxslam.io.atomic_files import write_atomically
from jaxslam.visualization.plots import png

_CELLS = 12
"""Cells along the width of the image in which residuals are averaged."""
_FEWEST = 5
"""Residuals that a cell must have."""
_DEPTH_BINS = 12


def plot_calibration(calibration: Calibration, path: Path, *, title: str = "") -> None:
    """Write one picture: mean residuals over the image, and of depth over depth, before and after.

    Arrows lead from where points are seen to where they should be, with one scale for both. They are means over cells,
    in which the noise of single points is averaged out: what is left is the error of the camera.

    Args:
        calibration: Result of a calibration.
        path: File of the picture, a PNG.
        title: Line above the picture; empty for none.

    Raises:
        CameraError: If the file cannot be written.
    """
    field = calibration.residuals
    figure = Figure(figsize=(9, 6.5), layout="constrained")
    arrows, depths = figure.subplots(2, 2, sharey="row")
    means = [
        _cell_means(field.uv, residuals, calibration.start.width) for residuals in (field.before_px, field.after_px)
    ]
    longest = max((float(np.hypot(*vectors).max()) for _, vectors in means if vectors.size), default=1.0)
    for axes, (centers, vectors), when in zip(arrows, means, ("before", "after"), strict=True):
        _draw_arrows(axes, centers, vectors, longest)
        axes.set(
            title=f"{when}: mean of a cell {_root_mean_square(vectors):.3f} px",
            xlim=(0, calibration.start.width - 1),
            ylim=(calibration.start.height - 1, 0),
            aspect="equal",
        )
    for axes, residuals in zip(depths, (field.depth_before_m, field.depth_after_m), strict=True):
        _draw_depths(axes, field.depth_m, residuals)
    depths[0].set_ylabel("expected - measured [mm]")
    figure.suptitle(title, fontsize=9)
    write_atomically(path, png(figure), CameraError)


def _cell_means(uv: np.ndarray, residuals: np.ndarray, width: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the centers `(2, c)` of cells of the image, and the median residuals `(2, c)` in them."""
    side = width / _CELLS
    cells, place = np.unique(np.floor(uv / side).astype(int), axis=1, return_inverse=True)
    enough = np.flatnonzero(np.bincount(place.ravel(), minlength=cells.shape[1]) >= _FEWEST)
    vectors = [np.median(residuals[:, place.ravel() == cell], axis=1) for cell in enough]
    return side * (cells[:, enough] + 0.5), np.array(vectors).reshape(-1, 2).T


def _draw_arrows(axes: Axes, centers: np.ndarray, vectors: np.ndarray, longest: float) -> None:
    if vectors.size:
        scale = longest / 30  # the longest arrow is 30 pixels long
        axes.quiver(*centers, *vectors, color="tab:blue", angles="xy", scale_units="xy", scale=scale, width=0.004)
    axes.set_xlabel("u [px]")


def _draw_depths(axes: Axes, depth_m: np.ndarray, residuals_m: np.ndarray) -> None:
    """Draw the median residual of depth, and its quartiles, over depth."""
    axes.axhline(0, color="0.6", linewidth=0.8)
    axes.set_xlabel("depth [m]")
    axes.grid(alpha=0.3)
    if not depth_m.size:
        return
    edges = np.quantile(depth_m, np.linspace(0, 1, _DEPTH_BINS + 1))
    inside = [(depth_m >= low) & (depth_m <= high) for low, high in pairwise(edges)]
    quartiles = np.array([np.quantile(1e3 * residuals_m[each], [0.25, 0.5, 0.75]) for each in inside if each.any()])
    middles = np.array([np.median(depth_m[each]) for each in inside if each.any()])
    axes.fill_between(middles, quartiles[:, 0], quartiles[:, 2], color="tab:orange", alpha=0.25, linewidth=0)
    axes.plot(middles, quartiles[:, 1], color="tab:orange")


def _root_mean_square(vectors: np.ndarray) -> float:
    return float(np.sqrt(np.square(vectors).sum(axis=0).mean())) if vectors.size else float("nan")
