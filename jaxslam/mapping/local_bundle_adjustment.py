"""Local bundle adjustment around a keyframe: select the window from the map, solve it, and write the result back."""

from typing import Any, NamedTuple

import jax
import numpy as np
from jaxslam_kernels.bundle.bundle_adjust import BundleAdjustment, BundleStatus, bundle_adjust
from jaxslam_kernels.bundle.cost import Observations as BundleObservations
from jaxslam_kernels.pose_graph.cost import PoseGraphEdges
from jaxslam_kernels.types import Scalar
from jaxtyping import Array, Bool, Float, Float32, Int

from jaxslam.config.schema import MappingConfig, TrackConfig
from jaxslam.dynamics.occlusion import state_weights
from jaxslam.geometry.se3 import between, compose, inverse, rotate, to_local, transform
from jaxslam.geometry.types import Ids, Points, Pose, Poses
from jaxslam.map.edit import with_positions, without_observations
from jaxslam.map.graph_edges import padded_edges
from jaxslam.map.point_records import NONE, Observations, distinct, has, observations_at, rows
from jaxslam.map.spanning_tree import ancestor_outside
from jaxslam.map.types import Map, covisible
from jaxslam.runtime.compiled import compiled
from jaxslam.runtime.compiler_options import FAST_COMPILE
from jaxslam.runtime.padding import padded

_NUM_FIXED = 4
"""Number of keyframes outside the window that are held fixed."""
_POINT_SIZES = (512, 1536)
"""Numbers of points that a window is padded to; each size is compiled once."""
_OBSERVATIONS_A_POINT = 6
_MIN_KEYFRAMES = 4
"""Minimum number of keyframes. With fewer, tracking is more accurate: it has tracked the points through all frames in
between. With people in two or three keyframes, adjusting turned 2.6 mm into 4.1 mm in the synthetic room."""
STRONG = 100
"""Number of common points from which they alone tell the relative pose of a keyframe and its parent."""
EDGE_PX = 1.0
"""Standard deviation of that relative pose where there are fewer: how far it moves the points in view, pixels."""
_TOLERANCE = 1e-3
"""Share of the cost: a step that changes it by less is the last one. With 1e-3 a window of fr1_rpy takes five to nine
steps; with 1e-4 it takes all ten, for the same error. Always five make the rendered road, where a car drives off, 5 %
worse."""
_OUTLIER_CHI2 = 11.3
"""Squared whitened error above which an observation is dropped: 1 % of the good ones with three residuals."""


_MAPPING, _TRACKING = MappingConfig(), TrackConfig()  # the only place of defaults


class AdjustPlan(NamedTuple):
    """Settings of local bundle adjustment.

    Attributes:
        window: Number of keyframes that are adjusted.
        max_steps: Maximum number of solver steps.
        loss_scale: Scale of the Cauchy loss, in standard deviations.
        depth_sigma_m: Standard deviation of depth measured close to the camera, in meters.
        depth_sigma_per_m2: Growth of that standard deviation with the square of depth, per meter.
        occluded_weight: Weight of OCCLUDED points, where others have 1.
    """

    window: int = _MAPPING.window
    max_steps: int = _MAPPING.max_steps
    loss_scale: float = _TRACKING.loss_scale
    depth_sigma_m: float = _TRACKING.depth_sigma_m
    depth_sigma_per_m2: float = _TRACKING.depth_sigma_per_m2
    occluded_weight: float = 1.0


class _Window(NamedTuple):
    keyframes: Ids
    """Ids, the adjusted keyframes first."""
    num_free: int
    """Number of adjusted keyframes."""
    points: Ids
    """Ids, ascending."""
    observations: Observations
    """Observations of the points in the keyframes."""
    row: Int[np.ndarray, " s"]
    """Row of each observation in the map."""


def adjust_around(slam_map: Map, keyframe_id: int, plan: AdjustPlan, movable: Ids | None = None) -> Map:
    """Adjust a keyframe, its covisible keyframes and their points to fit their observations best.

    Outlier observations are dropped. Everything outside the window stays; a window that cannot be solved leaves the map
    unchanged.

    Args:
        slam_map: The map, or a part of it.
        keyframe_id: Id of the keyframe at the center of the window.
        plan: Settings of the adjustment.
        movable: Ascending ids of the keyframes that may move; in a partial map, those whose points are all in it. By
            default all may.
    """
    window = _window(slam_map, keyframe_id, plan, slam_map.ids if movable is None else movable)
    if window is None:
        return slam_map
    reference = slam_map.T_world_cam[slam_map.row(keyframe_id)]
    poses, X = _solve_input(slam_map, window, reference)
    size = next(
        size for size in _POINT_SIZES if size >= len(window.points) and size * _OBSERVATIONS_A_POINT >= len(window.row)
    )
    num_cameras = plan.window + _NUM_FIXED
    free = np.arange(num_cameras) < window.num_free
    solution: Any = jax.device_get(
        _adjust(
            padded(poses, num_cameras, axis=0, fill=_identity_row()),
            padded(X, size, axis=1, fill=0),
            _observations(slam_map, window, size, plan),
            _tree_edges(slam_map, window, num_cameras),
            ~free,
            np.float32(plan.loss_scale),
            max_steps=plan.max_steps,
        )
    )
    if solution.status not in (BundleStatus.OK, BundleStatus.NOT_CONVERGED):
        return slam_map
    return _put_back(slam_map, window, reference, solution)


def adjust_all(slam_map: Map, plan: AdjustPlan, movable: Ids, sweeps: int = 2) -> Map:
    """Adjust some keyframes (ids, ascending) window by window, in several sweeps.

    As one problem they would need a Schur complement over all keyframes. Windows that overlap by half propagate the
    change of a loop, and each costs the same however many there are.
    """
    for _ in range(sweeps):
        for keyframe_id in movable[:: max(plan.window // 2, 1)].tolist():
            slam_map = adjust_around(slam_map, keyframe_id, plan, movable)
    return slam_map


def compile_adjustment(plan: AdjustPlan) -> None:
    """Compile the adjustment for every window size, so that nothing is compiled while frames arrive."""
    num_cameras = plan.window + _NUM_FIXED
    poses = padded(_identity_row()[None], num_cameras, axis=0, fill=_identity_row())
    for size in _POINT_SIZES:
        X, free = np.zeros((3, size), np.float32), np.zeros(num_cameras, bool)
        nothing = _no_observations(size * _OBSERVATIONS_A_POINT)
        none = np.zeros(0, np.int64)
        no_edges = padded_edges(none, none, np.zeros((0, 7)), np.zeros((0, 6, 6)), num_cameras)
        scale = np.float32(plan.loss_scale)
        jax.block_until_ready(_adjust(poses, X, nothing, no_edges, free, scale, max_steps=plan.max_steps))


def _no_observations(room: int) -> BundleObservations:
    plane: Any = np.zeros((3, room), np.float32)
    index: Any = np.zeros(room, np.int32)
    return BundleObservations(index, index, plane[:2], plane[0], plane, plane[0], plane[0] > 0)


def _window(slam_map: Map, keyframe_id: int, plan: AdjustPlan, movable: Ids) -> _Window | None:
    """Select the window; `None` if nothing holds it fixed or nothing can move."""
    near, _ = covisible(slam_map, keyframe_id)
    submap = slam_map.submap[slam_map.row(keyframe_id)]
    near = near[(slam_map.submap[rows(slam_map.ids, near)] == submap) & has(movable, near)]
    free = np.concatenate([[keyframe_id], near[: plan.window - 1]])
    # The first keyframe of a submap never moves: it defines the frame of the submap.
    first = slam_map.parent[rows(slam_map.ids, free)] == NONE
    first, free = free[first], free[~first]
    of_window = has(np.sort(free), slam_map.observations.keyframe)
    points, _ = distinct(slam_map.observations.point[of_window])
    others = ~of_window & has(points, slam_map.observations.point)
    outside, shared = distinct(slam_map.observations.keyframe[others])
    # And the keyframe that this one came from, however few points they share: then the edges in between hold it.
    ancestor = ancestor_outside(slam_map, keyframe_id, free)
    few = ancestor != NONE and ancestor not in outside[shared >= STRONG]
    kept = np.union1d(first, [ancestor] if few else []).astype(np.int64)
    most = outside[np.lexsort((outside, -shared))]
    held = np.concatenate([kept, most[~np.isin(most, kept)]])[:_NUM_FIXED]
    if not len(free) or not len(held) or len(free) + len(held) < _MIN_KEYFRAMES:
        return None
    keyframes = np.concatenate([free, held])
    of_both = has(np.sort(keyframes), slam_map.observations.keyframe) & has(points, slam_map.observations.point)
    points, counts = distinct(slam_map.observations.point[of_both])
    points, counts = points[counts > 1], counts[counts > 1]
    best = np.argsort(-counts, kind="stable")[: _POINT_SIZES[-1]]
    best = best[np.cumsum(counts[best]) <= _POINT_SIZES[-1] * _OBSERVATIONS_A_POINT]
    points = np.sort(points[best])
    row = np.flatnonzero(of_both & has(points, slam_map.observations.point))
    if not len(row):
        return None
    return _Window(keyframes, len(free), points, observations_at(slam_map.observations, row), row)


def _solve_input(
    slam_map: Map, window: _Window, reference: Pose
) -> tuple[Float32[np.ndarray, "k 7"], Float32[np.ndarray, "3 n"]]:
    """Express poses and points in the axes of the reference, so that float32 suffices far from the world's origin."""
    poses = between(reference[None, :], slam_map.T_world_cam[rows(slam_map.ids, window.keyframes)])
    X = to_local(reference, slam_map.points.X_world[:, rows(slam_map.points.ids, window.points)])
    return poses.astype(np.float32), X.astype(np.float32)


class Measurements(NamedTuple):
    """Measurements of `s` observations, in the form that bundle adjustment takes.

    Attributes:
        xy: `(2, s)` normalized coordinates in the ideal image.
        depth: `(s,)` measured depths, meters; 0 where there is none.
        precision: `(3, s)` inverse standard deviations: of the two coordinates, and of depth per meter.
        weights: `(s,)` weights of the observation and its point, multiplied.
    """

    xy: Float[np.ndarray, "2 s"]
    depth: Float[np.ndarray, " s"]
    precision: Float[np.ndarray, "3 s"]
    weights: Float[np.ndarray, " s"]


def measurements(slam_map: Map, seen: Observations, plan: AdjustPlan) -> Measurements:
    """Return the measurements of some observations of a map."""
    camera = slam_map.camera
    sigma_depth = plan.depth_sigma_m + plan.depth_sigma_per_m2 * np.square(seen.depth)
    focal = np.array([[camera.fx], [camera.fy]])
    center = np.array([[camera.cx], [camera.cy]])
    at = rows(slam_map.points.ids, seen.point)
    weight = seen.weight * slam_map.points.weight[at]
    if plan.occluded_weight != 1:
        weight = weight * state_weights(slam_map.points.state[at], plan.occluded_weight)
    of_depth = np.divide(1, sigma_depth, out=np.zeros_like(sigma_depth), where=seen.depth > 0)
    precision = np.concatenate([focal / seen.sigma_px, of_depth[None, :]])
    return Measurements((seen.uv - center) / focal, seen.depth, precision, weight)


def _observations(slam_map: Map, window: _Window, size: int, plan: AdjustPlan) -> BundleObservations:
    seen, measured = window.observations, measurements(slam_map, window.observations, plan)
    room = size * _OBSERVATIONS_A_POINT
    row = _places(window.keyframes, seen.keyframe)
    point_row = np.searchsorted(window.points, seen.point)
    fit: Any = lambda array, dtype: padded(array.astype(dtype), room, axis=-1, fill=0)
    valid: Any = np.arange(room) < len(row)
    return BundleObservations(
        camera=fit(row, np.int32),
        point=fit(point_row, np.int32),
        xy=fit(measured.xy, np.float32),
        depth=fit(measured.depth, np.float32),
        precision=fit(measured.precision, np.float32),
        weights=fit(measured.weights, np.float32),
        valid=valid,
    )


def _tree_edges(slam_map: Map, window: _Window, room: int) -> PoseGraphEdges:
    """Return the edges of the spanning tree between keyframes that share few points, as they are before the adjustment.

    What the tracker knows of the motion between two keyframes is in their common points, if there are many. Of a
    keyframe after a fast turn, all of 27 observations were wrong matches with another place, and moved it by 0.19 m.
    """
    parents = slam_map.parent[rows(slam_map.ids, window.keyframes)]
    child = np.flatnonzero(np.isin(parents, window.keyframes))
    parent = _places(window.keyframes, parents[child])
    seen = np.zeros((len(window.keyframes), len(window.points)), np.float32)
    of_keyframe, of_point = window.observations.keyframe, window.observations.point
    seen[_places(window.keyframes, of_keyframe), rows(window.points, of_point)] = 1
    few = np.sum(seen[parent] * seen[child], axis=1) < STRONG
    parent, child = parent[few], child[few]
    poses = slam_map.T_world_cam[rows(slam_map.ids, window.keyframes)]
    X_world = slam_map.points.X_world[:, rows(slam_map.points.ids, window.points)]
    distance = np.median(np.linalg.norm(X_world - poses[0, 4:, None], axis=0))
    sigma = EDGE_PX / slam_map.camera.fx
    information = np.tile(np.diag(np.repeat([sigma * distance, sigma], 3) ** -2.0), (len(child), 1, 1))
    return padded_edges(parent, child, between(poses[parent], poses[child]), information, room)


@compiled(when="warm-up", static="max_steps", options=FAST_COMPILE)
def _adjust(
    poses: Float[Array, "k 7"],
    X: Float[Array, "3 n"],
    observations: BundleObservations,
    edges: PoseGraphEdges,
    fixed: Bool[Array, " k"],
    loss_scale: Scalar,
    *,
    max_steps: int,
) -> BundleAdjustment:
    return bundle_adjust(
        poses,
        X,
        observations,
        fixed_poses=fixed,
        num_movable=poses.shape[0] - _NUM_FIXED,
        edges=edges,
        scale=loss_scale,
        tolerance=_TOLERANCE,
        max_steps=max_steps,
    )


def _put_back(slam_map: Map, window: _Window, reference: Pose, solution: Any) -> Map:
    poses = compose(reference[None, :], solution.poses[: window.num_free].astype(np.float64))
    good = solution.determined[: len(window.points)]
    X_world = transform(reference, solution.X_world[:, : len(window.points)].astype(np.float64))
    free = window.keyframes[: window.num_free]
    lone, along = _moved_along(slam_map, free, poses)
    ids, places = np.concatenate([window.points[good], lone]), np.concatenate([X_world[:, good], along], axis=1)
    slam_map = with_positions(slam_map, free, poses, ids, places)
    wrong = np.zeros(len(slam_map.observations.keyframe), bool)
    wrong[window.row] = ~(solution.chi2[: len(window.row)] < _OUTLIER_CHI2)
    return without_observations(slam_map, wrong)


def _moved_along(slam_map: Map, keyframe_ids: Ids, poses: Poses) -> tuple[Ids, Points]:
    """Return the points that only one of these keyframes observes, and their positions after it has moved."""
    row = rows(slam_map.points.ids, slam_map.observations.point)
    once = np.bincount(row, minlength=len(slam_map.points.ids))[row] == 1
    lone = np.flatnonzero(once & has(np.sort(keyframe_ids), slam_map.observations.keyframe))
    which = _places(keyframe_ids, slam_map.observations.keyframe[lone])
    change = compose(poses, inverse(slam_map.T_world_cam[rows(slam_map.ids, keyframe_ids)]))[which]
    X_world = rotate(change, slam_map.points.X_world[:, row[lone]].T) + change[:, 4:]
    return slam_map.observations.point[lone], X_world.T


def _places(ids: Ids, wanted: Ids) -> Int[np.ndarray, " n"]:
    """Return the place of each wanted id among ids in any order."""
    order = np.argsort(ids)
    return order[rows(ids[order], wanted)]


def _identity_row() -> Float32[np.ndarray, "7"]:
    return np.array([1, 0, 0, 0, 0, 0, 0], np.float32)
