"""Normal equations of one block of frames, of which points and poses are eliminated: what is left is of the camera.

Points share no residual with each other, and blocks share nothing but the camera. So the whole problem, however long
the recording, is solved by small dense matrices, one block after the other.

Source: Triggs et al., "Bundle Adjustment: A Modern Synthesis", 2000, section 6.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.linalg import cho_factor, cho_solve

from jaxslam.calibration.residuals import NUM_POINT, NUM_POSE, Linearized
from jaxslam.calibration.track_block import TrackBlock

LOSS_SCALE = 2.0
"""Scale of the Cauchy loss in standard deviations, of a pixel and of a depth."""
_FLOOR = 1e-9
"""Share of the largest entry that is added to the diagonal, so that a point seen along one ray has an inverse; one that
is not seen at all has that of 1."""


class Noise(NamedTuple):
    """Standard deviations of what is measured.

    Attributes:
        pixel: Of each coordinate of a tracked point, pixels.
        depth: Of the measured inverse depth, as a factor of `DepthPlanes.sigma`.
        shared: Of the error that all measurements of the depth of a point share, as the same factor.
    """

    pixel: float
    depth: float
    shared: float


class Weighted(NamedTuple):
    """Residuals in standard deviations, and what the robust loss makes of them.

    Attributes:
        residuals: `(f, 3, p)` residuals in standard deviations, 0 where nothing is seen or measured.
        weights: `(f, 3, p)` weights of iteratively reweighted least squares.
        shared: `(p,)` errors that all measurements of the depth of a point share, as factors of `DepthPlanes.sigma`.
        shared_weights: `(p,)` inverse variances of those, times the weights of the robust loss.
        cost: Cost of the block.
    """

    residuals: Float[np.ndarray, "f 3 p"]
    weights: Float[np.ndarray, "f 3 p"]
    shared: Float[np.ndarray, " p"]
    shared_weights: Float[np.ndarray, " p"]
    cost: float


class Reduced(NamedTuple):
    """Normal equations of a block without its points and poses, and what leads back to those.

    Attributes:
        hessian: `(q, q)` Hessian by the free parameters of the camera.
        gradient: `(q,)` gradient by them.
        pose_step: `(6 (f - 1),)` step of all poses but the first if the camera stays as it is.
        pose_by_camera: `(6 (f - 1), q)` derivative of that step by the step of the camera.
        point_step: `(p, 4)` step of the points if nothing else moves.
        point_by_rest: `(p, 4, d)` derivative of that step by the steps of the poses but the first and of the camera.
    """

    hessian: Float[np.ndarray, "q q"]
    gradient: Float[np.ndarray, " q"]
    pose_step: Float[np.ndarray, " c"]
    pose_by_camera: Float[np.ndarray, "c q"]
    point_step: Float[np.ndarray, "p 4"]
    point_by_rest: Float[np.ndarray, "p 4 d"]

    def steps(self, camera_step: Float[np.ndarray, " q"]) -> tuple[np.ndarray, np.ndarray]:
        """Return the steps of the poses `(f, 6)` and of the points `(4, p)` that go with a step of the camera."""
        poses = self.pose_step + self.pose_by_camera @ camera_step
        points = self.point_step + self.point_by_rest @ np.concatenate([poses, camera_step])
        return np.concatenate([np.zeros(6), poses]).reshape(-1, 6), points.T


def weighted(
    block: TrackBlock, points: Float[np.ndarray, "4 p"], residuals: Float[np.ndarray, "f 3 p"], noise: Noise
) -> Weighted:
    """Whiten the residuals of a block and weigh them by the Cauchy loss; see `jaxslam_kernels.robust`."""
    scales = np.array([noise.pixel, noise.pixel, noise.depth])[:, None]
    seen = np.stack([block.seen, block.seen, block.measured], axis=1)
    white = np.where(seen, residuals / scales, 0.0)
    squares = np.stack([white[:, 0] ** 2 + white[:, 1] ** 2, white[:, 2] ** 2], axis=1) / LOSS_SCALE**2
    weights = (1 / (1 + squares))[:, [0, 0, 1]] * seen
    shared_squares = np.square(points[3] / noise.shared) / LOSS_SCALE**2
    shared_weights = 1 / (1 + shared_squares) / noise.shared**2
    cost = 0.5 * LOSS_SCALE**2 * (np.log1p(squares).sum() + np.log1p(shared_squares).sum())
    return Weighted(white, weights, points[3], shared_weights, float(cost))


def reduce_block(
    linearized: Linearized, parts: Weighted, noise: Noise, free: Bool[np.ndarray, " q"], damping: float
) -> Reduced:
    """Eliminate the points and all poses but the first, which stays where it is.

    Args:
        linearized: Residuals and derivatives of the block.
        parts: Its weighted residuals.
        noise: Standard deviations.
        free: Which parameters of the camera are free.
        damping: Share of the diagonal that is added to it, for poses and points.
    """
    jacobian, residuals = _whitened(linearized, parts, noise)
    kept = np.concatenate([np.arange(NUM_POSE), NUM_POSE + NUM_POINT + np.flatnonzero(free)])
    rest, point = jacobian[..., kept], jacobian[..., NUM_POSE : NUM_POSE + NUM_POINT]
    rest_T, point_T = np.swapaxes(rest, -1, -2), np.swapaxes(point, -1, -2)
    hessian, gradient, cross = _assembled(rest, rest_T @ residuals, rest_T @ point)
    inner, pull = _of_points(point_T, residuals, parts, damping)
    inverse = np.linalg.inv(inner)
    point_by_rest = -inverse @ np.swapaxes(cross, -1, -2)
    point_step = -(inverse @ pull)[..., 0]
    num_poses = len(hessian) - int(free.sum())
    hessian[:num_poses, :num_poses] += _damped(hessian[:num_poses, :num_poses], damping)
    flat = np.swapaxes(cross, 1, 2).reshape(-1, len(hessian))
    schur = hessian + point_by_rest.reshape(-1, len(hessian)).T @ flat
    reduced = gradient + np.einsum("pdx,px->d", cross, point_step)
    poses, camera = slice(0, num_poses), slice(num_poses, None)
    factor = cho_factor(schur[poses, poses] + _damped(schur[poses, poses], 0.0))
    by_camera = -cho_solve(factor, schur[poses, camera])
    step = -cho_solve(factor, reduced[poses])
    return Reduced(
        hessian=schur[camera, camera] + schur[camera, poses] @ by_camera,
        gradient=reduced[camera] + schur[camera, poses] @ step,
        pose_step=step,
        pose_by_camera=by_camera,
        point_step=point_step,
        point_by_rest=point_by_rest,
    )


def shares_of_points(
    linearized: Linearized, parts: Weighted, noise: Noise, free: Bool[np.ndarray, " q"], reduced: Reduced
) -> tuple[Float[np.ndarray, "p k"], Float[np.ndarray, "p k k"]]:
    """Split the reduced normal equations of a block into what each of its points adds to gradient and Hessian.

    Args:
        linearized: Residuals and derivatives of the block.
        parts: Its weighted residuals.
        noise: Standard deviations.
        free: Which parameters of the camera are free.
        reduced: The reduced equations, without damping.
    """
    jacobian, residuals = _whitened(linearized, parts, noise)
    num_frames = len(jacobian)
    # How a step of the camera moves the residuals if all poses follow it.
    by_pose = np.concatenate([np.zeros((6, int(free.sum()))), reduced.pose_by_camera]).reshape(num_frames, 6, -1)
    around = np.clip(np.arange(num_frames)[:, None] + np.array([-1, 0, 1]), 0, num_frames - 1)
    following = by_pose[around].reshape(num_frames, 1, NUM_POSE, -1)
    rows = jacobian[..., :NUM_POSE] @ following + jacobian[..., NUM_POSE + NUM_POINT :][..., free]
    point = jacobian[..., NUM_POSE : NUM_POSE + NUM_POINT]
    rows_T, point_T = np.swapaxes(rows, -1, -2), np.swapaxes(point, -1, -2)
    inner, pull = _of_points(point_T, residuals, parts, 0.0)
    cross = (point_T @ rows).sum(axis=0)
    back = np.swapaxes(cross, -1, -2) @ np.linalg.inv(inner)
    gradient = (rows_T @ residuals).sum(axis=0) - back @ pull
    return gradient[..., 0], (rows_T @ rows).sum(axis=0) - back @ cross


def shared_variances(linearized: Linearized, parts: Weighted, noise: Noise) -> Float[np.ndarray, " p"]:
    """Return the variance of the shared error of each point if poses and camera are known; see `Weighted.shared`.

    Args:
        linearized: Residuals and derivatives of the block.
        parts: Its weighted residuals.
        noise: Standard deviations.
    """
    jacobian, residuals = _whitened(linearized, parts, noise)
    point_T = np.swapaxes(jacobian[..., NUM_POSE : NUM_POSE + NUM_POINT], -1, -2)
    return np.linalg.inv(_of_points(point_T, residuals, parts, 0.0)[0])[:, -1, -1]


def _whitened(
    linearized: Linearized, parts: Weighted, noise: Noise
) -> tuple[Float[np.ndarray, "f p 3 t"], Float[np.ndarray, "f p 3 1"]]:
    """Return derivatives and residuals in standard deviations, times the square roots of the weights.

    Frames, points, residuals, tangents: the small sums are over the last but one.
    """
    factors = np.sqrt(parts.weights) / np.array([noise.pixel, noise.pixel, noise.depth])[:, None]
    # What is not seen has no weight, whatever its derivative, which may not even be a number.
    jacobian = np.where(factors[..., None] > 0, linearized.jacobian, 0.0) * factors[..., None]
    residuals = np.sqrt(parts.weights) * parts.residuals
    # In memory as the axes say: everything that follows goes along the last one, in half of the time.
    whitened = np.ascontiguousarray(np.moveaxis(jacobian, 1, 2))
    return whitened, np.moveaxis(residuals, 1, 2)[..., None]


def _of_points(
    point_T: Float[np.ndarray, "f p 4 3"], residuals: Float[np.ndarray, "f p 3 1"], parts: Weighted, damping: float
) -> tuple[Float[np.ndarray, "p 4 4"], Float[np.ndarray, "p 4 1"]]:
    """Return Hessian and gradient of each point alone."""
    inner = (point_T @ np.swapaxes(point_T, -1, -2)).sum(axis=0)
    pull = (point_T @ residuals).sum(axis=0)
    inner[:, -1, -1] += parts.shared_weights
    pull[:, -1, 0] += parts.shared_weights * parts.shared
    return inner + _damped(inner, damping), pull


def _assembled(
    rest: Float[np.ndarray, "f p 3 c"], pulls: Float[np.ndarray, "f p c 1"], crosses: Float[np.ndarray, "f p c 4"]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Sum up Hessian, gradient, and the part between them and the points; the first pose is left out."""
    num_frames, num_points, _, c = rest.shape
    size = 6 * num_frames + c - NUM_POSE
    hessian, gradient, cross = np.zeros((size, size)), np.zeros(size), np.zeros((num_points, size, NUM_POINT))
    for frame in range(num_frames):
        # At an end there is no frame before or after, and nothing depends on it.
        around = frame + np.array([-1, 0, 1])
        there = np.flatnonzero((around >= 0) & (around < num_frames))
        poses = slice(6 * around[there[0]], 6 * around[there[-1]] + 6), slice(6 * there[0], 6 * there[-1] + 6)
        camera = slice(6 * num_frames, size), slice(NUM_POSE, c)
        rows = rest[frame].reshape(-1, c)
        squares, pull = rows.T @ rows, pulls[frame, ..., 0].sum(axis=0)
        for place, own in (poses, camera):
            gradient[place] += pull[own]
            cross[:, place] += crosses[frame][:, own]
            for other_place, other in (poses, camera):
                hessian[place, other_place] += squares[own, other]
    return hessian[6:, 6:], gradient[6:], cross[:, 6:]


def _damped(blocks: np.ndarray, damping: float) -> np.ndarray:
    """Return what is added to the diagonals of `(..., d, d)` matrices."""
    diagonal = np.diagonal(blocks, axis1=-2, axis2=-1)
    largest = diagonal.max(axis=-1, keepdims=True)
    added = damping * diagonal + np.where(diagonal > 0, _FLOOR * largest, 1.0)
    return added[..., None] * np.eye(blocks.shape[-1])
