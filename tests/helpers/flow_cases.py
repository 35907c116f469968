"""Image pairs with points to follow, one for every way a search can end, and compiled forms of the flow."""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from equinox.debug import assert_max_traces
from jaxslam_kernels.flow.lk_flow import DEFAULT_PLAN, Flow, FlowStatus, lk_flow
from jaxslam_kernels.image.pyramid import build_pyramid

from jaxslam.benchmark.kernels.scenes.image_warps import corners, picture, warp

WIDTH, HEIGHT = 160, 120
N = 45  # not a multiple of the chunk


class Inputs(NamedTuple):
    """What a flow is computed from."""

    previous: Any
    current: Any
    points: Any
    guess: Any
    mask: Any
    min_texture: Any


def flow_of(method, num_levels, plan=DEFAULT_PLAN):
    """A function of images, traced no more than once."""
    build = partial(build_pyramid, num_levels=num_levels)

    def run(inputs: Inputs) -> Flow:
        previous, current, points, guess, mask, min_texture = inputs
        return method(build(previous), build(current), points, guess, mask, min_texture=min_texture, plan=plan)

    return assert_max_traces(run, max_traces=1)


track = jax.jit(flow_of(lk_flow, 2))


def weighted_sum(flow, weights):
    """A loss that touches every differentiable output of every point."""
    outputs = (*flow.points, flow.residual, flow.texture, flow.correlation)
    return sum(jnp.sum(weight * output) for weight, output in zip(weights, outputs, strict=True))


def with_gradient(run):
    """The flow, and the gradient of a loss along images, points and guess."""

    def loss(moving, fixed, weights):
        flow = run(Inputs(*moving, *fixed))
        return weighted_sum(flow, weights), flow

    return lambda inputs, weights: jax.grad(loss, has_aux=True)(inputs[:4], inputs[4:], weights)


def random_weights(seed, dtype: type = np.float64):
    scale = np.array([[1.0], [1.0], [0.1], [0.01], [10.0]])
    return (np.random.default_rng(seed).normal(size=(5, N)) * scale).astype(dtype)


def image_pair(seed=0, shift_px=4.0, dtype: type = np.float32):
    """Fresh arrays; they may be written to until they are given to JAX, which reads them when it gets to it."""
    known = warp(picture(WIDTH, HEIGHT), shift_px, seed)
    previous, current = known.previous.astype(dtype), known.current.astype(dtype)
    points = corners(known.previous, N).astype(dtype)
    return Inputs(previous, current, points, points.copy(), np.ones(N, bool), np.array(1, dtype)), known


def one_of_each(dtype: type):
    """Points for every way a search can end, over and over, and the status each should get."""
    inputs, _ = image_pair(shift_px=2.0, dtype=dtype)
    inputs.previous[60:110, 10:60] = 90  # no texture
    steep = inputs.current[0:70, 90:160]
    steep[:] = 128 + 3 * (steep - 128)  # Gauss-Newton steps three times too long
    inputs.previous[100:102, 140] = np.nan
    places = {
        FlowStatus.OK: (80, 40),
        FlowStatus.MASKED: (80, 40),
        FlowStatus.OUTSIDE: (-3, 40),
        FlowStatus.NO_TEXTURE: (35, 85),
        FlowStatus.NOT_CONVERGED: (124, 30),
        FlowStatus.BAD_INPUT: (138, 98),
    }
    turn = np.arange(N) % len(places)
    points = np.array(list(places.values()), dtype).T[:, turn]
    expected = np.array(list(places))[turn]
    return inputs._replace(points=points, guess=points, mask=expected != FlowStatus.MASKED), expected


def within(points, low, high, margin=0):
    low, high = np.array(low)[:, None] - margin, np.array(high)[:, None] + margin
    return np.all((points >= low) & (points <= high), axis=0)


def distances(a, b):
    return np.linalg.norm(np.asarray(a) - b, axis=0)


def all_finite(tree):
    return all(bool(np.isfinite(leaf).all()) for leaf in jax.tree.leaves(tree))
