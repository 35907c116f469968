"""Points of weight zero in bundle adjustment: where they would go if their weight rose, for derivatives only.

A point of weight w adds `w c(cameras, X)` to the cost. However small w is, the point goes to its own optimum X* given
the cameras, and the cameras feel `w c(cameras, X*)`. At exactly 0 the point stays where it started. So the derivative
by a weight of 0, as the limit from above, is taken at X*. The forward computation does not come here.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from jaxslam_kernels.bundle.cost import BundleProblem, Plane, bundle_views
from jaxslam_kernels.bundle.equations import normal_equations
from jaxslam_kernels.bundle.lens import Cameras
from jaxslam_kernels.bundle.schur import inverse_root
from jaxslam_kernels.pose.pose_cost import FARTHEST_M
from jaxslam_kernels.robust import Loss, loss_value
from jaxslam_kernels.types import Mask, Points, Weights

_MAX_STEPS = 100
_INITIAL_DAMPING, _DAMPING_FACTOR, _MAX_DAMPING = 1e-4, 10.0, 1e9


class Idle(NamedTuple):
    """Free points none of whose observations has weight.

    Attributes:
        mask: True for idle points.
        rising: Those that a rising weight of the point would give observations: the others need more than one weight
            to rise, and any single observation can be fitted exactly, at no cost.
        X_world: Positions for the cost, meters: rising idle points at their own optimum, all others unchanged.
    """

    mask: Mask
    rising: Mask
    X_world: Points


class _Search(NamedTuple):
    X_world: Points
    cost: Weights
    damping: Weights
    done: Mask
    num_steps: Array


def idle_points(cameras: Cameras, X_world: Points, problem: BundleProblem, relative: Plane, loss: Loss) -> Idle:
    """Finds the idle points and their own optimum, the cameras held; constant for differentiation.

    Args:
        cameras: The adjusted cameras.
        X_world: The adjusted points, meters.
        problem: The problem that was solved.
        relative: Weights of the observations on the grid, without those of the points.
        loss: The robust loss, static.
    """
    cameras, X_world, problem, relative = lax.stop_gradient((cameras, X_world, problem, relative))
    idle = problem.free_point & (problem.weights == 0).all(axis=0)
    rising = idle & (relative > 0).any(axis=0)
    alone = problem._replace(weights=jnp.where(rising[None, :], relative, 0.0))
    return Idle(idle, rising, _settled(cameras, X_world, alone, rising, loss))


def _settled(cameras: Cameras, X_world: Points, problem: BundleProblem, free: Mask, loss: Loss) -> Points:
    """The free points at the optimum of their own cost, by Levenberg-Marquardt, each with its own damping."""
    epsilon = float(jnp.finfo(X_world.dtype).eps)

    def cost_of(X_world: Points) -> Weights:
        chi2 = bundle_views(cameras, X_world, problem, loss).chi2
        return 0.5 * jnp.sum(problem.weights * loss_value(chi2, problem.scale, loss), axis=0, where=problem.known)

    def step(state: _Search) -> _Search:
        equations = normal_equations(bundle_views(cameras, state.X_world, problem, loss))
        shift = _step(equations.point_hessian, equations.point_gradient, free, state.damping)
        promised = -jnp.sum(equations.point_gradient * shift, axis=0)
        trial = state.X_world + shift
        cost = cost_of(trial)
        near = (jnp.abs(trial) < FARTHEST_M).all(axis=0)  # false for NaN
        better = near & jnp.isfinite(cost) & (cost <= (1.0 + 32.0 * epsilon) * state.cost)
        damping = state.damping * jnp.where(better, 1.0 / _DAMPING_FACTOR, _DAMPING_FACTOR)
        small = promised <= (1e4 * epsilon) ** 2 * jnp.maximum(state.cost, 1.0)
        return _Search(
            X_world=jnp.where(better[None, :], trial, state.X_world),
            cost=jnp.where(better, cost, state.cost),
            damping=jnp.maximum(damping, 4.0 * epsilon),
            done=state.done | small | (damping > _MAX_DAMPING),
            num_steps=state.num_steps + 1,
        )

    damping = jnp.full_like(X_world[0], _INITIAL_DAMPING)
    start = _Search(X_world, cost_of(X_world), damping, ~free, jnp.zeros((), jnp.int32))
    more = lambda state: ~state.done.all() & (state.num_steps < _MAX_STEPS)
    return lax.while_loop(more, step, start).X_world


def _step(hessian: Float[Array, "3 3 n"], gradient: Points, free: Bool[Array, " n"], damping: Weights) -> Points:
    root = inverse_root(hessian, free, damping)
    return -jnp.einsum("ijn,in->jn", root, jnp.einsum("ijn,jn->in", root, gradient))
