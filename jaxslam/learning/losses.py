"""Losses of estimated poses against true ones: mean squares, so that their derivatives are smooth at zero."""

from typing import Annotated, TypeAlias

import jax.numpy as jnp
from jaxlie import SE3
from jaxslam_kernels.se3 import between, lenient_promotion
from jaxslam_kernels.trajectory.alignment import AlignmentKind, ate
from jaxslam_kernels.types import Scalar, Weights
from jaxtyping import Array, Float

from jaxslam.tracking.state import TrackOutput

Poses: TypeAlias = Annotated[SE3, "n"]
"""`(n,)` poses `T_world_cam`, a batch."""


def pose_loss(
    estimated: Poses | TrackOutput, truth: Poses, *, weights: Weights | None = None, meters_per_radian: float = 1.0
) -> Scalar:
    """Return the mean squared error of poses in the world of `truth`, square meters.

    The tracker begins at the origin of its own world: give `init_state` the true first pose as `T_world_cam`, or use a
    loss that no world matters to.

    Args:
        estimated: `(n,)` estimated poses, or the outputs of `rollout`.
        truth: `(n,)` true poses at the same times.
        weights: `(n,)` weights of the poses, not negative; 1 by default.
        meters_per_radian: Length that an angle of one radian counts as, meters.

    Raises:
        ValueError: If the numbers of poses or weights differ.
    """
    poses, weights = _checked(estimated, truth, weights)
    apart = poses.translation() - truth.translation()
    return _mean_square(apart, between(truth, poses), weights, meters_per_radian)


def relative_pose_loss(
    estimated: Poses | TrackOutput,
    truth: Poses,
    *,
    step: int = 1,
    weights: Weights | None = None,
    meters_per_radian: float = 1.0,
) -> Scalar:
    """Return the mean squared error of the motion from each pose to one some frames later, square meters.

    It is the same in every world frame. Source: Sturm et al., IROS 2012, equations 1 and 2.

    Args:
        estimated: `(n,)` estimated poses, or the outputs of `rollout`.
        truth: `(n,)` true poses at the same times.
        step: Number of frames from one pose to the other, static.
        weights: `(n,)` weights of the poses, not negative; that of a motion is the product of those of its two poses.
        meters_per_radian: Length that an angle of one radian counts as, meters.

    Raises:
        ValueError: If the numbers of poses or weights differ, or there are not more poses than `step`.
    """
    poses, weights = _checked(estimated, truth, weights)
    if not 1 <= step < len(weights):
        raise ValueError(f"step: expected from 1 to {len(weights) - 1}, one less than the number of poses, got {step}")
    moved, truly = (between(_part(T, None, -step), _part(T, step, None)) for T in (poses, truth))
    error = between(truly, moved)
    return _mean_square(error.translation(), error, weights[:-step] * weights[step:], meters_per_radian)


def ate_loss(
    estimated: Poses | TrackOutput,
    truth: Poses,
    *,
    weights: Weights | None = None,
    alignment: AlignmentKind = "se3",
) -> Scalar:
    """Return the square of the absolute trajectory error (ATE, RMSE) after alignment, square meters.

    The derivative includes that of the alignment.

    Args:
        estimated: `(n,)` estimated poses, or the outputs of `rollout`.
        truth: `(n,)` true poses at the same times, in any world frame.
        weights: `(n,)` weights of the poses, not negative; 1 by default.
        alignment: Kind of alignment, static.

    Raises:
        ValueError: If the numbers of poses or weights differ.
    """
    poses, weights = _checked(estimated, truth, weights)
    errors = ate(poses.translation().T, truth.translation().T, weights, alignment=alignment)
    return jnp.square(errors.statistics.rmse)


def _checked(estimated: Poses | TrackOutput, truth: Poses, weights: Weights | None) -> tuple[Poses, Weights]:
    """Return the estimated poses and the weights, after checking their numbers."""
    poses = estimated.T_world_cam if isinstance(estimated, TrackOutput) else estimated
    shape = poses.wxyz_xyz.shape
    if len(shape) != 2:
        raise ValueError(f"estimated: expected a batch of poses (n, 7), got {shape}")
    if truth.wxyz_xyz.shape != shape:
        raise ValueError(f"truth: expected {shape} as estimated, got {truth.wxyz_xyz.shape}")
    if weights is None:
        return poses, jnp.ones(shape[0], poses.wxyz_xyz.dtype)
    if weights.shape != shape[:1]:
        raise ValueError(f"weights: expected {shape[:1]}, one for each pose, got {weights.shape}")
    return poses, weights


def _part(T: Poses, start: int | None, stop: int | None) -> Poses:
    return SE3(T.wxyz_xyz[start:stop])


def _mean_square(
    apart: Float[Array, "n 3"], T_true_estimated: Poses, weights: Weights, meters_per_radian: float
) -> Scalar:
    with lenient_promotion():
        turn = T_true_estimated.rotation().log().astype(apart.dtype)
    squares = jnp.sum(jnp.square(apart), axis=1) + jnp.sum(jnp.square(meters_per_radian * turn), axis=1)
    total = jnp.sum(weights)
    return jnp.sum(weights * squares) / jnp.where(total > 0, total, 1)
