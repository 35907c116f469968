"""Robust batch least squares over the camera, all poses and all points of blocks of frames.

Levenberg-Marquardt: the camera is what blocks share, everything else is eliminated block by block.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from jaxslam.calibration.depth_patches import DepthSettings, planes_at
from jaxslam.calibration.elimination import Noise, Reduced, reduce_block, shared_variances, shares_of_points, weighted
from jaxslam.calibration.parameters import CameraVector
from jaxslam.calibration.residuals import linearize, residuals_of
from jaxslam.calibration.track_block import TrackBlock
from jaxslam.geometry.se3 import retract

_FIRST_DAMPING, _LEAST_DAMPING, _MOST_DAMPING = 1e-7, 1e-10, 1e6
"""Shares of the diagonal. A camera and the poses that make up for its errors are told apart by small residuals: with
1e-3, steps along those directions are too short by far."""
_STEP = 10.0
_LEVEL = 1e-5
"""Share of the cost by which the last step lowers it."""
_LEAST_TOLD, _FEWEST_TOLD = 0.9, 24
"""Largest share of the variance of a shared error that may be left by the tracks, and points for which that holds."""
_LEAST_SHARED = 0.01
"""Smallest standard deviation of shared errors, in those of the settings."""
_SHORT = 0.05
"""Length of the last step of the camera, in standard deviations."""


@dataclass(frozen=True, eq=False)
class BatchProblem:
    """Tracks, start and assumptions of a solve.

    Attributes:
        blocks: The blocks of frames, all of one size.
        prior: Parameters of the camera before looking at the recording.
        prior_sigma: Their standard deviations.
        height: Rows of the image.
        noise: Standard deviations of what is measured.
        depth: Settings of the depth sensor, by which its depth is looked up; `None` if the depth of blocks is fixed.
    """

    blocks: Sequence[TrackBlock]
    prior: CameraVector
    prior_sigma: CameraVector
    height: int
    noise: Noise
    depth: DepthSettings | None = None


class BlockState(NamedTuple):
    """Poses and points of a block.

    Attributes:
        poses: `(f, 7)` poses, wxyz_xyz of T_world_cam.
        points: `(4, p)` points, meters, and the shared errors of their depth; see `linearize`.
    """

    poses: Float[np.ndarray, "f 7"]
    points: Float[np.ndarray, "4 p"]


@dataclass(frozen=True, eq=False)
class BatchSolution:
    """Result of a solve.

    Attributes:
        camera: Parameters of the camera.
        states: Poses and points of each block.
        costs: `(b,)` cost of each block, without what was known before.
        converged: Whether the last step was short and hardly lowered the cost; otherwise the steps ran out.
    """

    camera: CameraVector
    states: Sequence[BlockState]
    costs: Float[np.ndarray, " b"]
    converged: bool


def first_states(blocks: Sequence[TrackBlock]) -> list[BlockState]:
    """Return poses and points as they were tracked."""
    return [BlockState(block.poses, np.pad(block.X_world, ((0, 1), (0, 0)))) for block in blocks]


def solve_batch(
    problem: BatchProblem,
    camera: CameraVector,
    states: Sequence[BlockState],
    free: Bool[np.ndarray, " q"],
    *,
    max_steps: int = 25,
) -> BatchSolution:
    """Find the free parameters of the camera, and all poses and points.

    Args:
        problem: What is known.
        camera: Parameters to begin with; those that are not free stay.
        states: Poses and points to begin with.
        free: Which parameters are free; with none, the poses and points that fit the camera best are found.
        max_steps: Bound on the steps.
    """
    states, damping = list(states), _FIRST_DAMPING
    costs = _costs(problem, camera, states)
    cost = costs.sum() + _prior_cost(problem, camera)
    converged = False
    for _ in range(max_steps):
        equations = _equations(problem, camera, states, free, damping)
        step = np.zeros(len(camera))
        step[free], length = _camera_step(problem, camera, equations, free, damping)
        new_camera = camera + step
        new_states = [_moved(state, *each.steps(step[free])) for state, each in zip(states, equations, strict=True)]
        new_costs = _costs(problem, new_camera, new_states)
        new_cost = new_costs.sum() + _prior_cost(problem, new_camera)
        if not new_cost <= cost:  # not a number either
            damping *= _STEP
            if damping > _MOST_DAMPING:
                break
            continue
        converged = bool(cost - new_cost < _LEVEL * cost and length < _SHORT)
        camera, states, costs, cost = new_camera, new_states, new_costs, new_cost
        damping = max(damping / _STEP, _LEAST_DAMPING)
        if converged:
            break
    return BatchSolution(camera, states, costs, converged)


def _equations(
    problem: BatchProblem,
    camera: CameraVector,
    states: Sequence[BlockState],
    free: Bool[np.ndarray, " q"],
    damping: float,
) -> list[Reduced]:
    reduced = []
    for block, state in zip(problem.blocks, states, strict=True):
        linear = linearize(block, *state, camera, height=problem.height)
        parts = weighted(block, state.points, linear.residuals, problem.noise)
        reduced.append(reduce_block(linear, parts, problem.noise, free, damping))
    return reduced


def _camera_step(
    problem: BatchProblem,
    camera: CameraVector,
    equations: Sequence[Reduced],
    free: Bool[np.ndarray, " q"],
    damping: float,
) -> tuple[Float[np.ndarray, " k"], float]:
    """Return the step of the free parameters, and its length in standard deviations."""
    sigma = problem.prior_sigma[free]
    # In units of the prior, so that pixels and seconds weigh the same.
    hessian = sum((each.hessian for each in equations), np.zeros((len(sigma), len(sigma)))) * np.outer(sigma, sigma)
    gradient = sum((each.gradient for each in equations), np.zeros(len(sigma))) * sigma
    gradient = gradient + (camera - problem.prior)[free] / sigma
    hessian = hessian + np.eye(len(sigma)) + damping * np.diag(np.diagonal(hessian))
    step = -np.linalg.solve(hessian, gradient)
    return sigma * step, float(np.sqrt(max(-gradient @ step, 0.0)))


def _moved(state: BlockState, pose_steps: np.ndarray, point_steps: np.ndarray) -> BlockState:
    poses = np.array([retract(pose, step) for pose, step in zip(state.poses, pose_steps, strict=True)])
    return BlockState(poses, state.points + point_steps)


def _costs(problem: BatchProblem, camera: CameraVector, states: Sequence[BlockState]) -> Float[np.ndarray, " b"]:
    costs = [
        weighted(block, state.points, each, problem.noise).cost
        for state, (block, each, _) in zip(states, _residuals(problem, camera, states), strict=True)
    ]
    return np.array(costs)


def _residuals(
    problem: BatchProblem, camera: CameraVector, states: Sequence[BlockState]
) -> list[tuple[TrackBlock, np.ndarray, np.ndarray]]:
    """Return each block with its residuals, and with the pixels at which its depth images show its points."""
    settings = {"height": problem.height}
    return [
        (block, *residuals_of(block, *state, camera, **settings))
        for block, state in zip(problem.blocks, states, strict=True)
    ]


def _prior_cost(problem: BatchProblem, camera: CameraVector) -> float:
    return float(0.5 * np.square((camera - problem.prior) / problem.prior_sigma).sum())


def shares_at(
    problem: BatchProblem, solution: BatchSolution, free: Bool[np.ndarray, " q"]
) -> list[tuple[Float[np.ndarray, "p k"], Float[np.ndarray, "p k k"]]]:
    """Return what each point of each block adds to the normal equations at a solution, see `shares_of_points`."""
    shares = []
    for block, state in zip(problem.blocks, solution.states, strict=True):
        linear = linearize(block, *state, solution.camera, height=problem.height)
        parts = weighted(block, state.points, linear.residuals, problem.noise)
        reduced = reduce_block(linear, parts, problem.noise, free, 0.0)
        shares.append(shares_of_points(linear, parts, problem.noise, free, reduced))
    return shares


def estimated_noise(problem: BatchProblem, solution: BatchSolution) -> Noise:
    """Estimate the standard deviations of pixels and depths from the residuals, by their medians.

    A fit has as many numbers less to err in as it has unknowns.
    """
    pixels, depths, unknowns = [], [], 0
    for block, residuals, _ in _residuals(problem, solution.camera, solution.states):
        pixels.append(np.hypot(residuals[:, 0], residuals[:, 1])[block.seen])
        depths.append(np.abs(residuals[:, 2])[block.measured])
        unknowns += 6 * (block.num_frames - 1) + 3 * int(block.seen.any(axis=0).sum())
    of_pixels, of_depths = np.concatenate(pixels), np.concatenate(depths)
    measured = 2 * len(of_pixels) + len(of_depths)
    left = np.sqrt(measured / max(measured - unknowns, 1))
    pixel = left * np.median(of_pixels) / np.sqrt(2 * np.log(2))  # the median of a Rayleigh distribution
    depth = left * 1.4826 * np.median(of_depths) if len(of_depths) else problem.noise.depth
    return Noise(float(pixel), float(depth), _shared_noise(problem, solution))


def _shared_noise(problem: BatchProblem, solution: BatchSolution) -> float:
    """Estimate the standard deviation of what all measurements of the depth of a point share.

    Tracks alone tell it of points only that are seen from different places: an error is estimated smaller than it is by
    the share of its variance that is left.
    """
    errors = []
    for block, state in zip(problem.blocks, solution.states, strict=True):
        linear = linearize(block, *state, solution.camera, height=problem.height)
        parts = weighted(block, state.points, linear.residuals, problem.noise)
        left = shared_variances(linear, parts, problem.noise) / problem.noise.shared**2
        told = block.measured.any(axis=0) & (left < _LEAST_TOLD)
        errors.append(np.abs(parts.shared[told]) / np.sqrt(1 - left[told]))
    of_points = np.concatenate(errors)
    if len(of_points) < _FEWEST_TOLD:
        return problem.noise.shared
    return float(max(1.4826 * np.median(of_points), _LEAST_SHARED))


def residuals_of_states(problem: BatchProblem, solution: BatchSolution) -> list[Float[np.ndarray, "f 3 p"]]:
    """Return the residuals of each block at a solution; see `residuals_of`."""
    return [residuals for _, residuals, _ in _residuals(problem, solution.camera, solution.states)]


def with_depth_looked_up(problem: BatchProblem, solution: BatchSolution) -> BatchProblem:
    """Return the problem with measured depth looked up where the solution says that the depth images show the points.

    Raises:
        ValueError: If the problem has no settings of the depth sensor.
    """
    if problem.depth is None:
        raise ValueError("problem.depth: expected the settings of the depth sensor, got none")
    blocks = [
        block if block.patches is None else block._replace(depth=planes_at(block.patches, depth_uv, problem.depth))
        for block, _, depth_uv in _residuals(problem, solution.camera, solution.states)
    ]
    return replace(problem, blocks=blocks)
