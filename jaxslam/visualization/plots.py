"""Pictures of trajectories and their errors, drawn with Matplotlib and without a screen."""

import io
import os
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import NamedTuple

import matplotlib as mpl
import numpy as np
from matplotlib import font_manager
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure, SubFigure

from jaxslam.errors import TrajectoryError
from jaxslam.geometry.so3 import matrices
from jaxslam.io.atomic_files import write_atomically
from jaxslam.map.point_records import NONE, rows
from jaxslam.map.types import Map
from jaxslam.trajectory.evaluation import Evaluation
from jaxslam.trajectory.trajectory import Trajectory

PNG_LEVEL = 1
"""Pictures of a run are written in 0.17 s instead of 0.74 with Pillow's own level of 6, and are 12 % larger."""

PICTURE_FORMATS = ("png", "pdf", "svg")
"""Endings of files that pictures can be written to."""
_UNDATED = {"pdf": {"CreationDate": None}, "svg": {"Date": None}}  # equal pictures are equal files
_BREAK_INTERVALS = 3.0
_TRUTH_COLOR, _PATH_COLOR, _LOST_COLOR = "0.6", "tab:blue", "tab:red"
_FOLLOWED_COLOR, _NEW_COLOR = "lime", "orange"


@dataclass(frozen=True, eq=False)
class Snapshot:
    """One frame and the points in it.

    Attributes:
        title: Title above the frame.
        image: `(h, w, 3)` RGB or `(h, w)` gray image, uint8.
        uv: `(2, n)` points in pixels.
        weights: `(n,)` weight of each point, 0 to 1; points of weight 0 are not drawn.
        followed: `(n,)` whether each point was tracked from the previous frame; the others are new.
    """

    title: str
    image: np.ndarray
    uv: np.ndarray
    weights: np.ndarray
    followed: np.ndarray


def plot_trajectory(
    estimate: Trajectory,
    reference: Trajectory | None,
    evaluation: Evaluation | None,
    path: str | os.PathLike[str],
    snapshots: Sequence[Snapshot] = (),
    *,
    title: str = "",
) -> None:
    """Write one picture: the path and, if it was evaluated, the error over time and the figures; below, some frames.

    The path is seen along its flattest axis, at one scale. With an evaluation the estimate is drawn aligned and
    colored by error, and times without estimated poses are shaded; otherwise both paths are drawn as they are.

    Args:
        estimate: Estimated trajectory.
        reference: True trajectory; `None` if unknown.
        evaluation: Result of `evaluate(estimate, reference, ...)`; `None` without an evaluation.
        path: File of the picture. Its suffix, one of `PICTURE_FORMATS`, selects the format.
        snapshots: Frames that are shown with their points.
        title: Line above the picture; empty for none.

    Raises:
        TrajectoryError: If there is nothing to draw or the file cannot be written.
    """
    if not len(estimate):
        raise TrajectoryError("nothing to plot: the estimate holds no poses")
    height, frames_height = (7 if evaluation is None else 10), 3.2 * ((len(snapshots) + 1) // 2)
    figure = Figure(figsize=(8, height + frames_height), layout="constrained")
    plots: Figure | SubFigure = figure
    if snapshots:
        parts = np.asarray(figure.subfigures(2, 1, height_ratios=(height, frames_height)))
        plots = parts[0]
        _draw_snapshots(parts[1], snapshots)
    above = f"{title}\n" if title else ""
    if evaluation is None:
        _draw_paths(plots.add_subplot(), estimate, reference)
        plots.suptitle(f"{above}{len(estimate)} poses, not evaluated", fontsize=9)
    else:
        seen, over_time = plots.subplots(2, height_ratios=(3, 1))
        _draw_evaluated_paths(seen, reference, evaluation)
        _draw_errors(over_time, evaluation)
        plots.suptitle(f"{above}{evaluation}", fontsize=8, family="monospace", x=0.02, ha="left", wrap=True)
    _write_picture(figure, path)


def plot_map(slam_map: Map, trajectory: Trajectory, path: str | os.PathLike[str]) -> None:
    """Write one picture: points of the map by how many keyframes saw them, keyframes with their tree, loops, path.

    Two views, along the flattest axis of the points and along the next one. Gravity is not known: up is where the
    first keyframe has it.

    Args:
        slam_map: Map with at least one keyframe.
        trajectory: Trajectory of the camera in the world frame of the map.
        path: File of the picture. Its suffix, one of `PICTURE_FORMATS`, selects the format.

    Raises:
        TrajectoryError: If there is no keyframe, or the file cannot be written.
    """
    if not len(slam_map.ids):
        raise TrajectoryError("nothing to plot: the map holds no keyframes")
    seen = np.bincount(
        np.searchsorted(slam_map.points.ids, slam_map.observations.point), minlength=len(slam_map.points.ids)
    )
    order = np.argsort(seen, kind="stable")
    centers, X = slam_map.T_world_cam[:, 4:], slam_map.points.X_world[:, order].T
    low, high = np.percentile(np.concatenate([X, centers]), [1, 99], axis=0)
    by_extent = np.argsort(high - low, kind="stable").tolist()
    room = 0.05 * (high - low) + 0.1
    figure = Figure(figsize=(12, 6), layout="constrained")
    points = None
    for axes, hidden in zip(figure.subplots(1, 2), by_extent[:2], strict=True):
        view = _view(slam_map.T_world_cam[0], hidden)
        plane = [view.across, view.up]
        points = axes.scatter(*X[:, plane].T, s=1.5, c=seen[order], cmap="viridis", vmin=1, vmax=8, label="points")
        _draw_links(axes, slam_map, plane)
        _draw_path(axes, trajectory, plane, color=_PATH_COLOR, label="path")
        axes.plot(*centers[:, plane].T, "^", color="black", markersize=4, label="keyframes")
        (left, bottom), (right, top) = (low - room)[plane].tolist(), (high + room)[plane].tolist()
        axes.set(xlim=(right, left) if view.across_falls else (left, right), xlabel=f"{'xyz'[view.across]} [m]")
        axes.set(ylim=(top, bottom) if view.up_falls else (bottom, top), ylabel=f"{'xyz'[view.up]} [m]")
        axes.set(aspect="equal")
        axes.set_title(view.title, fontsize=9)
        axes.legend(fontsize=8)
    assert points is not None
    figure.colorbar(points, ax=figure.axes, label="keyframes that saw the point", shrink=0.8)
    figure.suptitle(
        f"{len(slam_map.ids)} keyframes, {len(slam_map.points.ids)} points,"
        f" {len(slam_map.observations.point)} observations,"
        f" {len(slam_map.loops.source)} loops, {len(np.unique(slam_map.submap))} submaps",
        fontsize=10,
    )
    _write_picture(figure, path)


class _View(NamedTuple):
    """View of the world along one of its axes.

    Attributes:
        title: From where, as the first keyframe has it.
        across: World axis, 0 to 2, that goes from left to right.
        up: World axis that goes from bottom to top.
        across_falls: Whether coordinates of the first one fall from left to right.
        up_falls: Whether coordinates of the other one fall from bottom to top.
    """

    title: str
    across: int
    up: int
    across_falls: bool
    up_falls: bool


def _view(T_world_cam: np.ndarray, hidden: int) -> _View:
    """The upright view along a world axis, for a camera with OpenCV's axes.

    Args:
        T_world_cam: `(7,)` pose of the camera that says where up is.
        hidden: World axis to look along, 0 to 2.
    """
    right, down, ahead = matrices(T_world_cam[:4]).T
    of_up = int(np.argmax(np.abs(down)))
    of_ahead = max({0, 1, 2} - {of_up}, key=lambda axis: abs(float(ahead[axis])))
    (of_right,) = {0, 1, 2} - {of_up, of_ahead}
    falls = {of_right: right[of_right] < 0, of_up: down[of_up] > 0, of_ahead: ahead[of_ahead] < 0}
    views = {
        of_up: ("from above", of_right, of_ahead),
        of_ahead: ("from behind", of_right, of_up),
        of_right: ("from the right", of_ahead, of_up),
    }
    title, across, up = views[hidden]
    return _View(title, across, up, bool(falls[across]), bool(falls[up]))


def plot_snapshots(snapshots: Sequence[Snapshot], path: str | os.PathLike[str]) -> None:
    """Write one picture: frames with their points, two side by side.

    Args:
        snapshots: At least one frame with its points.
        path: File of the picture. Its suffix, one of `PICTURE_FORMATS`, selects the format.

    Raises:
        TrajectoryError: If the file cannot be written.
    """
    figure = Figure(figsize=(8, 3.2 * ((len(snapshots) + 1) // 2)), layout="constrained")
    _draw_snapshots(figure, snapshots)
    _write_picture(figure, path)


def picture_format(path: str | os.PathLike[str]) -> str:
    """Return the format of a picture by the suffix of its file.

    Raises:
        TrajectoryError: If the suffix is none of `PICTURE_FORMATS`.
    """
    ending = Path(path).suffix.lower().removeprefix(".")
    if ending not in PICTURE_FORMATS:
        raise TrajectoryError(f"{os.fspath(path)}: expected a file that ends in .png, .pdf or .svg, got '.{ending}'")
    return ending


def png(figure: Figure) -> bytes:
    """Render a figure as a PNG."""
    _add_own_fonts()
    picture = io.BytesIO()
    FigureCanvasAgg(figure).print_png(picture, pil_kwargs={"compress_level": PNG_LEVEL})
    return picture.getvalue()


def with_breaks(timestamps_ns: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Rows of a path, `(n,)` or `(n, k)`, with NaN between those so far apart in time that no line should join them."""
    return np.insert(rows, np.flatnonzero(_breaks(timestamps_ns)) + 1, np.nan, axis=0)


@cache
def _add_own_fonts() -> None:
    """Have Matplotlib know the fonts that come with it, whatever the list in the user's cache folder says.

    All Matplotlibs of a version share that list. One whose own fonts were out of reach when it made the list, as in an
    environment being removed, leaves it without them, and every label of a logarithmic axis is then a warning.
    """
    known = {Path(font.fname) for font in font_manager.fontManager.ttflist}
    for path in sorted(Path(mpl.get_data_path(), "fonts", "ttf").glob("*.ttf")):
        if path not in known:
            font_manager.fontManager.addfont(path)


def _picture(figure: Figure, kind: str) -> bytes:
    """A figure as a file of one of `PICTURE_FORMATS`."""
    if kind == "png":
        return png(figure)
    _add_own_fonts()
    picture = io.BytesIO()
    with mpl.rc_context({"svg.hashsalt": "jaxslam"}):
        figure.savefig(picture, format=kind, metadata=_UNDATED[kind])
    return picture.getvalue()


def _write_picture(figure: Figure, path: str | os.PathLike[str]) -> None:
    write_atomically(path, _picture(figure, picture_format(path)), TrajectoryError)


def _draw_links(axes: Axes, slam_map: Map, plane: list[int]) -> None:
    """The spanning tree, and loops."""
    children = np.flatnonzero(slam_map.parent != NONE)
    parents = rows(slam_map.ids, slam_map.parent[children])
    loops = rows(slam_map.ids, slam_map.loops.source), rows(slam_map.ids, slam_map.loops.target)
    for (first, second), color, label in (((parents, children), "0.5", None), (loops, _LOST_COLOR, "loops")):
        ends = np.stack([slam_map.T_world_cam[first, 4:], slam_map.T_world_cam[second, 4:]], axis=1)[:, :, plane]
        if len(ends):
            axes.add_collection(LineCollection(list(ends), colors=color, linewidths=1.0, label=label))


def _draw_snapshots(figure: Figure | SubFigure, snapshots: Sequence[Snapshot]) -> None:
    every = figure.subplots((len(snapshots) + 1) // 2, 2, squeeze=False).ravel()
    for axes in every:
        axes.set_axis_off()
    for axes, snapshot in zip(every, snapshots, strict=False):
        axes.imshow(snapshot.image, cmap="gray", vmin=0, vmax=255)
        axes.set_title(snapshot.title, fontsize=8)
        alive = snapshot.weights > 0
        colors = np.where(snapshot.followed[:, None], to_rgba(_FOLLOWED_COLOR), to_rgba(_NEW_COLOR))
        colors[:, 3] = snapshot.weights
        axes.scatter(*snapshot.uv[:, alive], s=4, c=colors[alive])
    figure.supxlabel("points: followed in green, new in orange", fontsize=8)


def _draw_paths(axes: Axes, estimate: Trajectory, reference: Trajectory | None) -> None:
    shown = [estimate.positions] if reference is None else [estimate.positions, reference.positions]
    plane = _prepare(axes, np.concatenate(shown))
    if reference is not None:
        _draw_truth(axes, reference, plane)
    _draw_path(axes, estimate, plane, color=_PATH_COLOR, label="estimate")
    _mark_ends(axes, estimate.positions[:, plane])
    axes.legend(fontsize=8)


def _draw_evaluated_paths(axes: Axes, reference: Trajectory | None, evaluation: Evaluation) -> None:
    positions, errors = evaluation.positions_m, evaluation.errors_m
    truth = evaluation.reference_m if reference is None else reference.positions
    plane = _prepare(axes, np.concatenate([positions, truth]))
    if reference is not None:
        _draw_truth(axes, reference, plane)
    ends = np.stack([positions[:-1, plane], positions[1:, plane]], axis=1)
    whole = ~_breaks(evaluation.timestamps_ns)
    path = LineCollection(list(ends[whole]), linewidths=1.6, cmap="viridis", label="estimate, by error")
    path.set_array(0.5 * (errors[:-1] + errors[1:])[whole])
    path.set_clim(0.0, max(evaluation.ate_max_m, np.finfo(float).tiny))
    axes.add_collection(path)
    _mark_ends(axes, positions[:, plane])
    axes.legend(fontsize=8)
    axes.figure.colorbar(path, ax=axes, label="error [m]", shrink=0.8)


def _draw_errors(axes: Axes, evaluation: Evaluation) -> None:
    begin = min(evaluation.timestamps_ns[0], evaluation.lost_spans_ns.min(initial=evaluation.timestamps_ns[0]))
    seconds = (evaluation.timestamps_ns - begin) / 1e9
    over_time = with_breaks(evaluation.timestamps_ns, np.column_stack([seconds, evaluation.errors_m]))
    axes.plot(*over_time.T, color=_PATH_COLOR)
    rmse = f"rmse {evaluation.ate_rmse_m:.4f} m"
    axes.axhline(evaluation.ate_rmse_m, color="0.3", linestyle="--", linewidth=0.8, label=rmse)
    for k, (lost, found) in enumerate((_joined(evaluation.lost_spans_ns) - begin) / 1e9):
        label = "no estimate" if k == 0 else None
        axes.axvspan(lost, found, color=_LOST_COLOR, alpha=0.15, linewidth=0, label=label)
    axes.set(xlabel="time [s]", ylabel="error [m]")
    axes.set_ylim(bottom=0)
    axes.margins(x=0)
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)


def _joined(spans_ns: np.ndarray) -> np.ndarray:
    """`(k, 2)` spans in the order of time, those that touch made one: where poses are sparse, there are thousands."""
    if not len(spans_ns):
        return spans_ns
    apart = spans_ns[1:, 0] > spans_ns[:-1, 1]
    return np.column_stack([spans_ns[np.append(True, apart), 0], spans_ns[np.append(apart, True), 1]])


def _prepare(axes: Axes, positions: np.ndarray) -> list[int]:
    """Label and scale the axes; the two coordinates of largest extent, in the order of the alphabet."""
    plane = sorted(np.argsort(-np.ptp(positions, axis=0), kind="stable")[:2].tolist())
    axes.set_xlabel(f"{'xyz'[plane[0]]} [m]")
    axes.set_ylabel(f"{'xyz'[plane[1]]} [m]")
    axes.set_aspect("equal", adjustable="datalim")
    axes.grid(alpha=0.3)
    return plane


def _draw_truth(axes: Axes, reference: Trajectory, plane: list[int]) -> None:
    _draw_path(axes, reference, plane, color=_TRUTH_COLOR, label="ground truth")


def _draw_path(axes: Axes, trajectory: Trajectory, plane: list[int], color: str, label: str) -> None:
    u, v = with_breaks(trajectory.timestamps_ns, trajectory.positions[:, plane]).T
    axes.plot(u, v, color=color, linewidth=1.2, label=label)


def _mark_ends(axes: Axes, uv: np.ndarray) -> None:
    axes.plot(*uv[0], "o", color="black", markersize=5, label="begin")
    axes.plot(*uv[-1], "s", color="black", markersize=5, label="end")


def _breaks(timestamps_ns: np.ndarray) -> np.ndarray:
    """`(n - 1,)` which steps to the next pose bridge so long a time that no line should."""
    steps = np.diff(timestamps_ns)
    return steps > _BREAK_INTERVALS * np.median(steps) if len(steps) else np.zeros(0, bool)
