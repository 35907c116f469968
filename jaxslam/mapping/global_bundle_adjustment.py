"""Global bundle adjustment: all keyframes and points of a submap at once, beside tracking, in bounded memory.

Levenberg-Marquardt in double precision. The points are eliminated chunk by chunk, and what each chunk adds to the
equations of the keyframes is summed in a sparse matrix, which has a block for every two keyframes that observe common
points. So memory grows with the observations and with these pairs, never with all pairs. Between two chunks the caller
may end it.

The first keyframe of the submap stays where it is. What is not part of the problem, such as points that a single
keyframe observes, and what the map gets meanwhile, moves along.

Source: Triggs et al., "Bundle Adjustment: A Modern Synthesis", 2000, section 6; Mur-Artal and Tardos, "ORB-SLAM2",
2017, section III-D, for its place after a loop and for what moves along.
"""

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxslam_kernels.bundle.cost import Observations as BundleObservations
from jaxslam_kernels.bundle.point_chunk import EliminatedChunk, chunk_cost, eliminate_chunk
from jaxslam_kernels.types import Scalar
from jaxtyping import Array, Float, Float64, Int

from jaxslam.geometry.se3 import compose, inverse, retract, transform
from jaxslam.geometry.types import Ids, Points, Pose, Poses
from jaxslam.loop_closing.loop_correction import with_corrected_keyframes
from jaxslam.map.edit import with_positions
from jaxslam.map.point_records import NONE, Observations, has, observations_at, rows
from jaxslam.map.types import Map
from jaxslam.mapping.keyframe_equations import KeyframeEquations, WeakEdges, weak_edges
from jaxslam.mapping.local_bundle_adjustment import AdjustPlan, measurements
from jaxslam.runtime.compiled import compiled
from jaxslam.runtime.compiler_options import FAST_COMPILE, SINGLE_THREAD
from jaxslam.runtime.padding import padded

_CHUNK = 8192
"""Number of observations that are eliminated at a time; each program is compiled for it alone."""
_MAX_STEPS = 20
_TOLERANCE = 1e-4
"""Share of the cost: a step that changes it by less is the last one."""
_INITIAL_DAMPING, _DAMPING_FACTOR, _MIN_DAMPING, _MAX_DAMPING = 1e-6, 10.0, 1e-12, 1e3
"""Relative to the diagonal of the Hessian. A long round bends in directions whose share of it is a millionth."""


class AdjustedSubmap(NamedTuple):
    """A submap after global bundle adjustment.

    Attributes:
        anchor: Id of the keyframe that did not move.
        T_world_anchor: `(7,)` its pose.
        keyframes: `(k,)` ids of the adjusted keyframes, ascending.
        T_world_cam: `(k, 7)` their poses.
        points: `(p,)` ids of the adjusted points, ascending.
        X_world: `(3, p)` their positions, meters.
        initial_cost: Cost before: half the sum of the robust squared errors in standard deviations.
        cost: The same cost afterward.
        num_steps: Number of steps tried.
    """

    anchor: int
    T_world_anchor: Pose
    keyframes: Ids
    T_world_cam: Poses
    points: Ids
    X_world: Points
    initial_cost: float
    cost: float
    num_steps: int


class _InterruptedError(Exception):
    """The caller has ended the adjustment."""


class _Chunk(NamedTuple):
    """Some points with all their observations, sorted by point.

    Attributes:
        points: Columns of the points in the problem.
        camera: `(m,)` row of the keyframe of each observation.
        point: `(m,)` column of its point among those of the chunk.
        first: `(n,)` first observation of each point.
        measured: The observations, padded to the size of a chunk.
    """

    points: slice
    camera: Int[np.ndarray, " m"]
    point: Int[np.ndarray, " m"]
    first: Int[np.ndarray, " n"]
    measured: BundleObservations


class _Problem(NamedTuple):
    keyframes: Ids
    """Ascending ids."""
    anchor: int
    """Row of the keyframe that does not move."""
    points: Ids
    """Ascending ids."""
    chunks: list[_Chunk]
    edges: WeakEdges


class _State(NamedTuple):
    T_world_cam: Poses
    X_world: Float64[np.ndarray, "3 p"]


def adjust_submap(
    slam_map: Map, submap: int, plan: AdjustPlan, is_interrupted: Callable[[], bool] = lambda: False
) -> AdjustedSubmap | None:
    """Adjust all keyframes of a submap, and all points that two or more of them observe, to fit all observations best.

    Args:
        slam_map: The map.
        submap: Number of the submap.
        plan: Settings of the adjustment, of which `window` and `max_steps` are those of local adjustment only.
        is_interrupted: Function that tells whether to end early; called before every chunk of points, where it may
            wait.

    Returns:
        The adjusted submap; `None` if nothing in it can be adjusted, or if it was interrupted.
    """
    problem = _problem(slam_map, submap, plan)
    if problem is None:
        return None
    at = rows(slam_map.ids, problem.keyframes), rows(slam_map.points.ids, problem.points)
    start = _State(slam_map.T_world_cam[at[0]], slam_map.points.X_world[:, at[1]].astype(np.float64))
    solver = _Solver(problem, plan.loss_scale, is_interrupted)
    try:
        with jax.enable_x64(True):
            end, initial_cost, cost, num_steps = solver.solve(start)
    except _InterruptedError:
        return None
    return AdjustedSubmap(
        anchor=int(problem.keyframes[problem.anchor]),
        T_world_anchor=start.T_world_cam[problem.anchor],
        keyframes=problem.keyframes,
        T_world_cam=end.T_world_cam,
        points=problem.points,
        X_world=end.X_world,
        initial_cost=initial_cost,
        cost=cost,
        num_steps=num_steps,
    )


def with_adjusted_submap(slam_map: Map, adjusted: AdjustedSubmap) -> Map:
    """Return the map with an adjusted submap in it.

    The map may have changed meanwhile. Keyframes that the adjustment does not name move with their parent in the
    spanning tree, and points with their reference keyframe. If the submap was transformed, it stays where it is now.
    """
    there = has(slam_map.ids, adjusted.keyframes) & (adjusted.keyframes != adjusted.anchor)
    if not there.any():
        return slam_map
    T_now_then = compose(slam_map.pose(adjusted.anchor), inverse(adjusted.T_world_anchor))
    poses = compose(T_now_then, adjusted.T_world_cam[there])
    slam_map = with_corrected_keyframes(slam_map, adjusted.keyframes[there], poses)
    there = has(slam_map.points.ids, adjusted.points)
    X_world = transform(T_now_then, adjusted.X_world[:, there])
    return with_positions(slam_map, slam_map.ids[:0], np.zeros((0, 7)), adjusted.points[there], X_world)


class _Solver:
    """Levenberg-Marquardt on one problem."""

    def __init__(self, problem: _Problem, loss_scale: float, is_interrupted: Callable[[], bool]) -> None:
        self._problem, self._loss_scale, self._is_interrupted = problem, np.float64(loss_scale), is_interrupted

    def solve(self, state: _State) -> tuple[_State, float, float, int]:
        """Return the optimum from a start, the cost before and after, and the number of steps tried."""
        initial_cost = cost = self._cost(state)
        damping, num_steps, done = _INITIAL_DAMPING, 0, False
        while not done and num_steps < _MAX_STEPS and damping < _MAX_DAMPING:
            num_steps += 1
            trial = self._stepped(state, damping)
            trial_cost = np.inf if trial is None else self._cost(trial)
            if trial is None or not trial_cost <= cost:
                damping *= _DAMPING_FACTOR
                continue
            done = cost - trial_cost < _TOLERANCE * cost
            state, cost, damping = trial, trial_cost, max(damping / _DAMPING_FACTOR, _MIN_DAMPING)
        return state, initial_cost, cost, num_steps

    def _stepped(self, state: _State, damping: float) -> _State | None:
        """Return the state a step further; `None` if the equations have no solution."""
        equations = KeyframeEquations(len(self._problem.keyframes))
        eliminated = []
        for chunk in self._chunks():
            poses = _poses_from_points(chunk, state)
            part = jax.device_get(_eliminate(poses, chunk.measured, self._loss_scale, np.float64(damping)))
            equations.add_chunk(part, chunk.camera, chunk.point)
            eliminated.append(part._replace(hessian=part.hessian[:0], gradient=part.gradient[:0]))
        equations.add_edges(self._problem.edges, state.T_world_cam)
        step = equations.solve(self._problem.anchor, damping)
        if not np.isfinite(step).all():
            return None
        X_world = state.X_world.copy()
        for chunk, part in zip(self._chunks(), eliminated, strict=True):
            X_world[:, chunk.points] += _point_shifts(chunk, part, step)
        return _State(retract(state.T_world_cam, step), X_world)

    def _cost(self, state: _State) -> float:
        cost = self._problem.edges.cost(state.T_world_cam)
        for chunk in self._chunks():
            cost += float(_cost_of(_poses_from_points(chunk, state), chunk.measured, self._loss_scale))
        return cost

    def _chunks(self) -> Iterator[_Chunk]:
        for chunk in self._problem.chunks:
            if self._is_interrupted():
                raise _InterruptedError
            yield chunk


def _problem(slam_map: Map, submap: int, plan: AdjustPlan) -> _Problem | None:
    """Collect what a submap has to adjust; `None` if that is nothing."""
    inside = slam_map.ids[slam_map.submap == submap]
    first = inside[slam_map.parent[rows(slam_map.ids, inside)] == NONE]
    if len(inside) < 2 or not len(first):
        return None
    seen = observations_at(slam_map.observations, np.flatnonzero(has(inside, slam_map.observations.keyframe)))
    points, column, counts = np.unique(seen.point, return_inverse=True, return_counts=True)
    shared = counts[column] > 1
    if not shared.any():
        return None
    # Sorted by point, then by keyframe: the same problem for observations in any order.
    order = np.flatnonzero(shared)
    order = order[np.lexsort((seen.keyframe[order], seen.point[order]))]
    _, first_of_point, own = np.unique(seen.point[order], return_index=True, return_inverse=True)
    order = order[np.arange(len(order)) - first_of_point[own] < _CHUNK]  # a point has to fit into a chunk
    seen, points = observations_at(seen, order), points[counts > 1]
    edges = weak_edges(slam_map, inside, seen)
    used = np.zeros(len(inside), bool)
    used[rows(inside, seen.keyframe)] = used[edges.source] = used[edges.target] = used[rows(inside, first)] = True
    keyframes = inside[used]
    edges = edges.renumbered(np.cumsum(used) - 1)
    chunks = list(_divided(slam_map, keyframes, points, seen, plan))
    return _Problem(keyframes, int(rows(keyframes, first[:1])[0]), points, chunks, edges)


def _divided(slam_map: Map, keyframes: Ids, points: Ids, seen: Observations, plan: AdjustPlan) -> Iterator[_Chunk]:
    """Divide the observations, sorted by point, into chunks of whole points."""
    camera, column = rows(keyframes, seen.keyframe), rows(points, seen.point)
    measured = measurements(slam_map, seen, plan)
    ends = np.searchsorted(column, np.arange(len(points)), side="right")
    begin = 0
    while begin < len(column):
        end = int(ends[np.searchsorted(ends, begin + _CHUNK, side="right") - 1])
        those = slice(int(column[begin]), int(column[end - 1]) + 1)
        point = column[begin:end] - those.start
        fit: Any = lambda values, b=begin, e=end: padded(values[..., b:e].astype(np.float64), _CHUNK, axis=-1)
        xy, depth, precision, weights = map(fit, measured)
        index: Any = padded(point.astype(np.int32), _CHUNK, fill=_CHUNK)
        valid: Any = np.arange(_CHUNK) < end - begin
        yield _Chunk(
            points=those,
            camera=camera[begin:end],
            point=point,
            first=np.flatnonzero(np.diff(point, prepend=-1)),
            measured=BundleObservations(index, index, xy, depth, precision, weights, valid),
        )
        begin = end


def _poses_from_points(chunk: _Chunk, state: _State) -> Float64[np.ndarray, "m 7"]:
    """Return the pose of each observation's keyframe with the world's origin at the point."""
    poses = np.zeros((_CHUNK, 7))
    poses[:, 0] = 1
    num = len(chunk.camera)
    poses[:num] = state.T_world_cam[chunk.camera]
    poses[:num, 4:] -= state.X_world[:, chunk.points].T[chunk.point]
    return poses


def _point_shifts(chunk: _Chunk, part: EliminatedChunk, step: Float[np.ndarray, "k 6"]) -> Points:
    """Return the shifts `(3, n)` of the points of a chunk, given the step of the keyframes."""
    num, n = len(chunk.camera), len(chunk.first)
    pulled = np.einsum("mci,mc->im", part.coupling[:num], step[chunk.camera])
    along = part.along[:, :n] + np.add.reduceat(pulled, chunk.first, axis=1)
    return -np.einsum("ijn,in->jn", part.root[:, :, :n], along)


@compiled(when="first use", options={**FAST_COMPILE, **SINGLE_THREAD})
def _eliminate(
    poses: Float[Array, "m 7"], measured: BundleObservations, loss_scale: Scalar, damping: Scalar
) -> EliminatedChunk:
    return eliminate_chunk(poses, measured, loss_scale, damping, "cauchy", num_points=_CHUNK // 2)


@compiled(when="first use", options={**FAST_COMPILE, **SINGLE_THREAD})
def _cost_of(poses: Float[Array, "m 7"], measured: BundleObservations, loss_scale: Scalar) -> Scalar:
    return chunk_cost(poses, measured, loss_scale, "cauchy")
