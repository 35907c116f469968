"""Predict the pose of a camera from its velocity, for as long as that has been steady."""

from typing import NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxlie import SE3
from jaxslam_kernels.se3 import retract
from jaxslam_kernels.types import Scalar
from jaxtyping import Array, Float

_FORGET = 0.9
"""Share of the statistics that is kept from one frame to the next."""


class VelocityStatistics(NamedTuple):
    """Recent speed of the camera and changes of its velocity: of translation, then of rotation.

    Both are sums over the frames, in which older ones count less. Only their ratio matters, which is a time: no length
    and no angle is taken for fast or slow.

    Attributes:
        squares: `(2,)` sum of the squared velocities, (m/s)^2 and (rad/s)^2.
        changes: `(2,)` sum of the squared changes of velocity from one frame to the next, divided by the time between
            them, (m/s)^2 / s and (rad/s)^2 / s.
    """

    squares: Float[Array, "2"]
    changes: Float[Array, "2"]


def updated_statistics(
    statistics: VelocityStatistics, before: Float[Array, "6"], after: Float[Array, "6"], elapsed_s: Scalar
) -> VelocityStatistics:
    """Take the velocity of a tracked frame into the statistics.

    The first velocity is no change: what was before it is not known.

    Args:
        statistics: Statistics of the frames before.
        before: `(6,)` velocity at the frame before, m/s, then rad/s.
        after: `(6,)` velocity at the frame.
        elapsed_s: Time between the two, seconds.
    """
    known = (elapsed_s > 0) & (statistics.squares > 0)
    rate = jnp.where(known, _squares(after - before) / jnp.where(known, elapsed_s, 1), 0)
    return VelocityStatistics(_FORGET * statistics.squares + _squares(after), _FORGET * statistics.changes + rate)


def predict_pose(T_world_cam: SE3, twist: Float[Array, "6"], statistics: VelocityStatistics, elapsed_s: Scalar) -> SE3:
    """Predict the pose of the camera some time after its last one.

    The velocity is taken for an Ornstein-Uhlenbeck process, which forgets it in the time tau after which changes have
    replaced it: `tau = 2 mean(v^2) / (mean(dv^2) / dt)`. The expected displacement after `t` is `v tau (1 - exp(-t /
    tau))`: that of constant velocity for a car, no more than `v tau` for a hand that shakes the camera. Translation and
    rotation have a `tau` each.

    Args:
        T_world_cam: Last pose.
        twist: `(6,)` velocity there in the camera's own axes, m/s, then rad/s.
        statistics: Statistics of the velocity.
        elapsed_s: Time since then, seconds; no motion is predicted if it is not positive.
    """
    elapsed_s = jnp.maximum(elapsed_s, 0)
    moved = statistics.squares > 0
    ages = 0.5 * elapsed_s * statistics.changes / jnp.where(moved, statistics.squares, 1)  # t / tau
    old = ages > 1e-3
    share = jnp.where(old, -jnp.expm1(-ages) / jnp.where(old, ages, 1), 1 - 0.5 * ages)
    lasting_s = lax.stop_gradient(elapsed_s * share)
    return retract(T_world_cam, twist * jnp.repeat(lasting_s, 3, total_repeat_length=6))


def _squares(twist: Float[Array, "6"]) -> Float[Array, "2"]:
    return jnp.sum(jnp.square(twist.reshape(2, 3)), axis=1)
