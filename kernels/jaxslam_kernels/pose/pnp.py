"""Robust absolute pose of an RGB-D camera: batched RANSAC with a fixed number of hypotheses.

All hypotheses are drawn, solved and scored at once: P3P on three points, the root chosen by a fourth and by measured
depths or near the depths that are expected, then one pass over hypotheses x points. The best one is refined, first on
all points under a redescending loss that is a smooth form of the score, then on its inliers. Which points are inliers
is a constant for differentiation; the last refinement carries the gradient (see `pose_refine`).
"""

from typing import NamedTuple

import jax.numpy as jnp
from jax import lax
from jax.typing import DTypeLike
from jaxlie import SE3, SO3
from jaxtyping import Array, Bool, Float, Int, Key

from jaxslam_kernels.camera import MIN_DEPTH, Intrinsics
from jaxslam_kernels.checks import checked
from jaxslam_kernels.pose.absolute_orientation import absolute_orientation
from jaxslam_kernels.pose.p3p import p3p, p3p_near
from jaxslam_kernels.pose.pose_cost import PosePrior, PoseProblem, pose_problem
from jaxslam_kernels.pose.pose_refine import PoseStatus, refine_problem, solve_pose, usable_pose
from jaxslam_kernels.ransac_sampling import draw_samples
from jaxslam_kernels.robust import Loss
from jaxslam_kernels.se3 import rotation_matrix
from jaxslam_kernels.types import Code, Flag, Mask, Pixels, Points, Scalar, Weights

SAMPLE_SIZE = 4
"""Three points for P3P and one to choose its root, of no use where depths are expected."""

_GATE_SIGMAS = 3.0  # a threshold is taken as so many standard deviations in the refinement
_NARROW = 0.5
"""Scale of the redescending loss, in thresholds: with 1 it is drawn from the right pose to one half way to a mover."""
_CONSENSUS_STEPS = 10

_Transforms = Float[Array, "3 4 h"]
"""`[R | t]` of T_cam_world, one a hypothesis."""


class PnpResult(NamedTuple):
    """A pose that many points agree on.

    Attributes:
        T_world_cam: The pose; the initial one (or the identity) if `status` says that none was found.
        inliers: True for points that agree with the pose. All false if none was found.
        num_inliers: Number of inliers.
        score: `Σ w (1 - min(e², 1))` with e the error in thresholds: the weight of the inliers, less for larger errors;
            `Σ w (1 - min(e, 1))²` if averaged. A prior takes away `eᵀ Λ e / 9` with its e and Λ, in which a threshold
            is three standard deviations too.
        status: A `PoseStatus`.
    """

    T_world_cam: SE3
    inliers: Mask
    num_inliers: Int[Array, ""]
    score: Scalar
    status: Code


@checked
def ransac_pnp(
    key: Key[Array, ""],
    X_world: Points,
    uv: Pixels,
    intrinsics: Intrinsics,
    *,
    weights: Weights | None = None,
    depth: Weights | None = None,
    initial: SE3 | None = None,
    expected_depth: Weights | None = None,
    threshold_px: Weights | Scalar | float = 3.0,
    threshold_depth: Weights | Scalar | float = 0.1,
    min_inliers: int = 8,
    num_hypotheses: int = 128,
    loss: Loss = "huber",
    max_steps: int = 25,
    tolerance: float | None = None,
    averaged: bool = False,
    on_inliers: bool = True,
    prior: PosePrior | None = None,
) -> PnpResult:
    """Finds the camera pose that most points agree on, among any number of wrong ones.

    With a share ω of good points the chance that all of h hypotheses fail is about `(1 - ω⁴)^h`: 3e-4 for half of
    them good, 128 hypotheses. Points count as in `refine_pose`: positive weight, everything finite.

    Args:
        key: Random key; the same key gives the same answer.
        X_world: Points in the world, meters. At least `SAMPLE_SIZE` usable ones, not all on a line.
        uv: Their image positions, pixels of the distorted image.
        intrinsics: The camera.
        weights: Weight of each point in the sampling and in the score; `None` for one each. The derivative by
            a weight of 0 is the limit from above.
        depth: Measured depths in meters, 0 or NaN where missing; `None` for pixels alone. They take part in the
            choice of the root, in the score and in the refinement.
        initial: A predicted pose, tried as one more hypothesis.
        expected_depth: Approximate depth of every point, meters, from which samples are solved by Newton's method
            (`p3p_near`); `None` to solve them in closed form (`p3p`). One that is not positive takes its point out of
            the samples' solutions, not out of the score.
        threshold_px: Largest error of an inlier in the image, pixels: about three standard deviations.
        threshold_depth: Largest error of an inlier along the optical axis, meters. The two combine:
            `e² = (pixels / threshold_px)² + (depth / threshold_depth)² < 1`.
        min_inliers: Fewer than this is no consensus.
        num_hypotheses: Number of samples, static.
        loss: The loss of the last refinement over the inliers, with a scale of half a threshold, static.
        max_steps: Bound on the steps of the last refinement, static.
        tolerance: Length of the step at which the last refinement stops, static; see `refine_pose`.
        averaged: Whether the score is averaged over thresholds, see `score_poses`, static.
        on_inliers: Whether the pose is refined on its inliers in the end, static. Without, it is the optimum of the
            redescending loss over all points: enough for a pose from which another refinement begins.
        prior: A pose known beforehand, with its information: it takes part in the score and in the refinement, so that
            it contradicts a crowd that carries the votes.

    Returns:
        A `PnpResult`; everything in it is finite.
    """
    if X_world.shape[1] == 0:
        return _none_found(_fallback(initial, X_world.dtype)[0])
    sigma_px, sigma_depth = (
        jnp.asarray(threshold, X_world.dtype) / _GATE_SIGMAS for threshold in (threshold_px, threshold_depth)
    )
    problem, idle = pose_problem(X_world, uv, intrinsics, weights, depth, sigma_px, sigma_depth, _GATE_SIGMAS, prior)
    fixed = lax.stop_gradient(problem)
    fallback, has_initial = _fallback(initial, X_world.dtype)
    samples = draw_samples(key, fixed.weights, num_hypotheses, SAMPLE_SIZE)
    hypotheses, real = _hypotheses(fixed, samples, lax.stop_gradient(expected_depth))
    hypotheses = jnp.concatenate([hypotheses, _as_transform(fallback)], axis=2)
    real = jnp.append(real, has_initial)
    scores = jnp.where(real, score_poses(hypotheses, fixed, averaged), -jnp.inf)
    best, _ = usable_pose(_as_pose(hypotheses[:, :, jnp.argmax(scores)]))
    if on_inliers:
        pose, status = _refined_on_inliers(best, problem, idle, loss, max_steps, tolerance, averaged)
    else:
        pose, status = _refined_robustly(best, problem, idle, max_steps, tolerance, averaged)
    return _result(pose, status, fixed, fallback, real.any(), min_inliers, averaged)


@checked
def score_poses(T_cam_world: _Transforms, problem: PoseProblem, averaged: bool = False) -> Float[Array, " h"]:
    """The score of each pose (see `PnpResult.score`), thresholds being `problem.scale` deviations.

    Averaged: `(1 - e)²` is the truncated squared error `1 - min(e² / s², 1)`, averaged over all thresholds s up to 1.
    Nobody knows the noise, and a pose that fits some points well is rather right than one that fits more of them badly
    (the idea of Barath, Matas and Noskova, "MAGSAC: marginalizing sample consensus", CVPR 2019). Without the average, a
    pose half way between a room and a box that is carried before it beats both.

    One fused pass over hypotheses x points: 40 us for 128 x 500 on one core. As a matrix product followed by the
    errors it takes 50 us, with an exponential map in the loop 9 ms.
    """
    error = _squared_errors(T_cam_world[..., None], *(o[..., None, :] for o in _observed(problem)))
    error = jnp.minimum(error, 1.0)
    agreement = jnp.square(1.0 - jnp.sqrt(error)) if averaged else 1.0 - error
    score = agreement @ problem.weights
    if problem.prior is None:
        return score
    return score - _prior_deviation(T_cam_world, problem.prior) / jnp.square(problem.scale)


def _prior_deviation(T_cam_world: _Transforms, prior: PosePrior) -> Float[Array, " h"]:
    """Squared deviation `eᵀ Λ e` of each pose from the prior, see `PosePrior`."""
    R_cam_world, t_cam_world = T_cam_world[:, :3], T_cam_world[:, 3]
    R_prior = rotation_matrix(prior.T_world_cam)
    position = -jnp.einsum("jih,jh->ih", R_cam_world, t_cam_world)
    offset = R_prior.T @ (position - prior.T_world_cam.translation()[:, None])
    R = jnp.einsum("ji,kjh->ikh", R_prior, R_cam_world)  # of the sought camera in the predicted one
    sines = jnp.stack([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    cosine = 0.5 * jnp.sqrt(jnp.maximum(1.0 + jnp.trace(R), 1e-6))  # of half the angle
    error = jnp.concatenate([offset, 0.5 * sines / cosine[None, :]])
    return jnp.einsum("ih,ij,jh->h", error, prior.information, error)


def _observed(problem: PoseProblem) -> tuple[Array, Array, Array, Array]:
    """Measurements for `_squared_errors`: points, directions, depths, and factors in units of the threshold."""
    return problem.X_world, problem.xy, problem.depth, problem.precision / problem.scale


def _squared_errors(T: Array, X_world: Array, xy: Array, depth: Array, precision: Array) -> Array:
    """`e²` in squared thresholds, 1 or more behind the camera; the axes behind the first broadcast."""
    x, y, z = X_world
    X, Y, Z = (row[0] * x + row[1] * y + row[2] * z + row[3] for row in T)
    inverse_z = 1.0 / jnp.maximum(Z, MIN_DEPTH)
    fu, fv, fd = precision
    eu, ev, ed = (X * inverse_z - xy[0]) * fu, (Y * inverse_z - xy[1]) * fv, (Z - depth) * fd
    return eu * eu + ev * ev + ed * ed + jnp.where(Z > MIN_DEPTH, 0.0, 1.0)


def _hypotheses(
    problem: PoseProblem, samples: Int[Array, "4 h"], expected_depth: Weights | None
) -> tuple[_Transforms, Bool[Array, " h"]]:
    """One pose a sample: of the up to four of P3P, the one that agrees best with what else was measured.

    With expected depths, the one near them.
    """
    X_world, xy, depth, precision = (o[..., samples] for o in _observed(problem))
    ray = jnp.concatenate([xy, jnp.ones_like(xy[:1])])
    inverse = lax.rsqrt(jnp.square(ray).sum(axis=0))
    bearings = ray * inverse[None, :, :]
    if expected_depth is None:
        distances, real = p3p(bearings[:, :3], X_world[:, :3])
    else:
        distances, real = p3p_near(bearings[:, :3], X_world[:, :3], expected_depth[samples[:3]] / inverse[:3])
    corners = distances[None, :, :, :] * bearings[:, :3, None, :]
    world_corners = jnp.broadcast_to(X_world[:, :3, None, :], corners.shape)
    R, t, spans = absolute_orientation(world_corners, corners)
    T = jnp.concatenate([R, t[:, None]], axis=1)  # (3, 4, solution, sample)
    if expected_depth is not None:
        return T[:, :, 0], (real & spans)[0]
    disagreement = _squared_errors(T[:, :, None], *(o[..., :, None, :] for o in (X_world, xy, depth, precision))).sum(
        axis=0
    )
    disagreement = jnp.where(real & spans, disagreement, jnp.inf)
    chosen = jnp.argmin(disagreement, axis=0)
    T = jnp.take_along_axis(T, chosen[None, None, None, :], axis=2)[:, :, 0, :]
    return T, (real & spans).any(axis=0)


def _refined_on_inliers(
    best: SE3,
    problem: PoseProblem,
    idle: PoseProblem,
    loss: Loss,
    max_steps: int,
    tolerance: float | None,
    averaged: bool,
) -> tuple[SE3, Code]:
    """Refine the best hypothesis on all points under a redescending loss, then on the points that agree with that."""
    fixed = lax.stop_gradient(problem)
    solved, _ = solve_pose(best, _narrowed(fixed, averaged), "geman_mcclure", _CONSENSUS_STEPS)
    consensus = _better(solved, best, fixed, averaged)
    inliers, _ = _consensus(consensus, fixed, averaged)
    on_inliers = problem._replace(weights=jnp.where(inliers, problem.weights, 0.0), scale=0.5 * problem.scale)
    refined = refine_problem(consensus, on_inliers, _agreeing_idle(consensus, idle), loss, max_steps, tolerance)
    return refined.T_world_cam, refined.status


def _refined_robustly(
    best: SE3, problem: PoseProblem, idle: PoseProblem, max_steps: int, tolerance: float | None, averaged: bool
) -> tuple[SE3, Code]:
    """Refine the best hypothesis on all points under a redescending loss."""
    narrowed, idle = (_narrowed(points, averaged) for points in (problem, idle))
    refined = refine_problem(best, narrowed, idle, "geman_mcclure", max_steps, tolerance)
    return _better(refined.T_world_cam, best, lax.stop_gradient(problem), averaged), refined.status


def _narrowed(problem: PoseProblem, averaged: bool) -> PoseProblem:
    """The problem with the scale of the redescending loss."""
    return problem._replace(scale=_NARROW * problem.scale) if averaged else problem


def _better(solved: SE3, best: SE3, problem: PoseProblem, averaged: bool) -> SE3:
    """The solved pose; averaged, the one before if the solution has led away to where fewer agree."""
    if not averaged:
        return solved
    better = _consensus(solved, problem, averaged)[1] > _consensus(best, problem, averaged)[1]
    return SE3(jnp.where(better, solved.wxyz_xyz, best.wxyz_xyz))


def _consensus(T_world_cam: SE3, problem: PoseProblem, averaged: bool) -> tuple[Mask, Scalar]:
    """Find the points that agree with a pose, and score it."""
    T = _as_transform(T_world_cam)
    error = _squared_errors(T, *_observed(problem))
    return (error < 1.0) & (problem.weights > 0), score_poses(T, problem, averaged)[0]


def _agreeing_idle(T_world_cam: SE3, idle: PoseProblem) -> PoseProblem:
    """Keep the points of weight 0 that would be inliers of a pose; only these have a derivative by their weight."""
    agrees = _squared_errors(_as_transform(T_world_cam), *_observed(lax.stop_gradient(idle))) < 1.0
    return idle._replace(weights=jnp.where(agrees, idle.weights, 0.0))


def _result(
    T_world_cam: SE3,
    status: Code,
    problem: PoseProblem,
    fallback: SE3,
    any_real: Array,
    min_inliers: int,
    averaged: bool,
) -> PnpResult:
    inliers, score = _consensus(T_world_cam, problem, averaged)
    num_inliers = jnp.sum(inliers, dtype=jnp.int32)
    usable = jnp.sum(problem.weights > 0)
    codes = PoseStatus.TOO_FEW_POINTS, PoseStatus.DEGENERATE, PoseStatus.NO_CONSENSUS
    status = jnp.select(
        [usable < SAMPLE_SIZE, ~any_real | (status == PoseStatus.DEGENERATE), num_inliers < min_inliers],
        [jnp.int32(code) for code in codes],
        status,
    )
    found = status <= PoseStatus.NOT_CONVERGED
    return PnpResult(
        T_world_cam=SE3(jnp.where(found, T_world_cam.wxyz_xyz, fallback.wxyz_xyz)),
        inliers=inliers & found,
        num_inliers=jnp.where(found, num_inliers, 0),
        score=jnp.where(found, score, 0.0),
        status=status,
    )


def _none_found(fallback: SE3) -> PnpResult:
    """The result of no points."""
    dtype = fallback.wxyz_xyz.dtype
    status = jnp.asarray(PoseStatus.TOO_FEW_POINTS, jnp.int32)
    return PnpResult(fallback, jnp.zeros(0, bool), jnp.zeros((), jnp.int32), jnp.zeros((), dtype), status)


def _fallback(initial: SE3 | None, dtype: DTypeLike) -> tuple[SE3, Flag]:
    """The initial pose and true, or the identity and false if there is none."""
    if initial is None:
        return SE3(jnp.zeros(7, dtype).at[0].set(1.0)), jnp.array(False)
    return usable_pose(initial)


def _as_transform(T_world_cam: SE3) -> Float[Array, "3 4 1"]:
    T_world_cam = lax.stop_gradient(T_world_cam)
    R_world_cam, position = rotation_matrix(T_world_cam), T_world_cam.translation()
    return jnp.concatenate([R_world_cam.T, -(R_world_cam.T @ position)[:, None]], axis=1)[:, :, None]


def _as_pose(T_cam_world: Float[Array, "3 4"]) -> SE3:
    R_world_cam = T_cam_world[:, :3].T
    return SE3.from_rotation_and_translation(SO3.from_matrix(R_world_cam), -(R_world_cam @ T_cam_world[:, 3]))
