"""Points of weight zero in bundle adjustment: where they would go if their weight rose, for derivatives only.

A point of weight w adds `w c(cameras, X)` to the cost. However small w is, the point goes to its own optimum X* given
the cameras, and the cameras feel `w c(cameras, X*)`. At exactly 0 the point stays where it started. So the derivative
by a weight of 0, as the limit from above, is taken at X*. The forward computation does not come here.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from jaxslam_kernels.bundle.cost import BundleProblem, Plane, bundle_views
from jaxslam_kernels.bundle.equations import exact_blocks, normal_equations
from jaxslam_kernels.bundle.lens import Cameras
from jaxslam_kernels.bundle.schur import inverse_root
from jaxslam_kernels.derivative_rules import implicit_shift
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

    def heard(self, problem: BundleProblem) -> BundleProblem:
        """Return the problem in which a weight that would rise alone has no derivative."""
        silent = self.mask & ~self.rising
        return problem._replace(weights=jnp.where(silent[None, :], 0.0, problem.weights))


class _Search(NamedTuple):
    X_world: Points
    cost: Weights
    damping: Weights
    done: Mask
    num_steps: Array


@partial(jax.jit, static_argnames="loss")  # traced once: derivatives need it several times
def idle_points(cameras: Cameras, X_world: Points, problem: BundleProblem, relative: Plane, loss: Loss) -> Idle:
    """Find the idle points and their own optimum, given the cameras.

    Args:
        cameras: The adjusted cameras.
        X_world: The adjusted points, meters.
        problem: The problem that was solved.
        relative: Weights of the observations on the grid, without those of the points.
        loss: The robust loss, static.
    """
    mask = problem.free_point & (problem.weights == 0).all(axis=0)
    rising = mask & (relative > 0).any(axis=0)
    alone = problem._replace(weights=jnp.where(rising[None, :], relative, 0.0))
    settled = _settled(*lax.stop_gradient((cameras, X_world, alone)), rising, loss)
    shift = implicit_shift(
        partial(_slope, loss), partial(_solve, loss), jnp.zeros_like(X_world), (settled, rising), (cameras, alone)
    )
    return Idle(mask, rising, jnp.where(rising[None, :], settled + shift, X_world))


def _slope(loss: Loss, shift: Points, optimum: tuple[Points, Mask], inputs: tuple[Cameras, BundleProblem]) -> Points:
    """Gradient of each idle point's own cost a step away from its optimum; of other points, the step."""
    (settled, rising), (cameras, alone) = optimum, inputs
    views = bundle_views(cameras, settled + jnp.where(rising[None, :], shift, 0.0), alone, loss)
    return jnp.where(rising[None, :], normal_equations(views).point_gradient, shift)


def _solve(loss: Loss, optimum: tuple[Points, Mask], inputs: tuple[Cameras, BundleProblem], right: Points) -> Points:
    """Solve for a step with the exact Hessian of each idle point; zero where that is not positive definite."""
    (settled, rising), (cameras, alone) = optimum, inputs
    hessian = exact_blocks(cameras, settled, alone, loss).point.sum(axis=2)
    return -_step(hessian, right, rising, jnp.zeros_like(right[0]))


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
