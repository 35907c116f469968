"""`docs/derivatives.md` holds: by which arguments each kernel has first and second derivatives, and which are constant.

Derivatives along a random change of one argument are compared with central differences, in float64: the first one with
differences of the value, and the gradient by everything else with differences of gradients.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import kernel_cases
import numpy as np
import pytest
from derivative_cases import MAKERS, DerivativeCase
from quick_compile import quick_compile

pytestmark = pytest.mark.usefixtures("float64")
FIRST, SECOND = 1e-5, 1e-3
"""Largest differences, relative."""


def _is_float(leaf: Any) -> bool:
    return jnp.issubdtype(jnp.asarray(leaf).dtype, jnp.floating)


def _split(result: Any, constant: tuple[str, ...]) -> tuple[list[jax.Array], list[jax.Array]]:
    """The floating-point results that have derivatives, and those that are constant."""
    varying, fixed = [], []
    for path, leaf in jax.tree_util.tree_leaves_with_path(result):
        if _is_float(leaf):
            name = getattr(path[0], "name", None) if path else None
            (fixed if name in constant else varying).append(jnp.asarray(leaf))
    return varying, fixed


class _At(NamedTuple):
    """Value and gradient at a point, and their changes along a direction there."""

    value: Any
    gradient: Any
    slope: Any
    curvature: Any


def _as_numpy(function: Callable[..., Any]) -> Callable[..., Any]:
    """The function with results of NumPy: JAX compiles each operation on them outside of a program, for each shape."""
    return lambda *arguments: jax.tree.map(np.asarray, function(*arguments))


class _Differentiator:
    """Derivatives of a sum of all results, of which each counts as much as any other; compiled once for all cases."""

    def __init__(self, case: DerivativeCase, call: Any) -> None:
        self._results = _as_numpy(quick_compile(lambda inputs: _split(call(**inputs), case.constant_results)[0]))

        def loss(inputs: dict[str, Any], probes: list[jax.Array]) -> jax.Array:
            results = _split(call(**inputs), case.constant_results)[0]
            return sum((jnp.vdot(*pair) for pair in zip(probes, results, strict=True)), jnp.zeros(()))

        def at(point: dict[str, Any], direction: dict[str, Any], probes: list[jax.Array]) -> _At:
            both = jax.value_and_grad(lambda inputs: loss(inputs, probes))
            (value, gradient), (slope, curvature) = jax.jvp(both, (point,), (direction,))
            return _At(value, gradient, slope, curvature)

        self.at = _as_numpy(quick_compile(at))

    def probes(self, inputs: dict[str, Any]) -> list[np.ndarray]:
        random = np.random.default_rng(7)
        size = lambda leaf: float(np.sqrt(np.mean(np.square(leaf)))) if leaf.size else 1.0
        return [np.asarray(random.normal(size=leaf.shape) / (size(leaf) or 1.0)) for leaf in self._results(inputs)]


def _direction(inputs: dict[str, Any], name: str) -> dict[str, Any]:
    """A random change of one argument, each array by about its own size."""
    random = np.random.default_rng(11)

    def change(leaf: jax.Array) -> np.ndarray:
        size = float(np.sqrt(np.mean(np.square(leaf)))) or 1.0
        return np.asarray(size * random.normal(size=leaf.shape))

    still = jax.tree.map(np.zeros_like, inputs)
    return still | {name: jax.tree.map(change, inputs[name])}


def _moved(inputs: dict[str, Any], direction: dict[str, Any], by: float) -> dict[str, Any]:
    return jax.tree.map(lambda x, d: np.asarray(x) + by * d, inputs, direction)


def _difference(values: dict[int, Any], h: float) -> Any:
    """The derivative by central differences of sixth order."""
    odd = lambda k: jax.tree.map(lambda ahead, behind: ahead - behind, values[k], values[-k])
    return jax.tree.map(lambda a, b, c: (45 * a - 9 * b + c) / (60 * h), odd(1), odd(2), odd(3))


def _largest(array: np.ndarray) -> float:
    return float(np.abs(array).max())


def _check(case: DerivativeCase, of: _Differentiator, inputs: dict[str, Any], singular: bool = False) -> None:
    """Compare the derivatives by each argument with differences."""
    probes = of.probes(inputs)
    for name in inputs:
        direction = _direction(inputs, name)
        here = of.at(inputs, direction, probes)
        _check_gradient(name, here, direction, singular)
        worst = {}
        for h in case.steps:
            near = {k: of.at(_moved(inputs, direction, k * h), direction, probes) for k in (-3, -2, -1, 1, 2, 3)}
            worst[h] = _worst(
                case.noise / h, here, *(_difference({k: one[i] for k, one in near.items()}, h) for i in (0, 1))
            )
            if worst[h][0] <= 1:
                break
        least, which = min(worst.values())
        assert least <= 1, f"{name}: {which} off by {least:.3g} times what is allowed; all steps: {worst}"


def _check_gradient(name: str, here: _At, direction: dict[str, Any], singular: bool) -> None:
    """Check that there is a gradient, and that forward and reverse mode agree."""
    products = jax.tree.map(lambda gradient, change: np.ravel(gradient * change), here.gradient, direction)
    parts = np.concatenate(jax.tree.leaves(products))
    assert np.isfinite(parts).all(), f"{name}: not finite"
    assert singular or np.abs(parts).max() > 0, f"{name}: no derivative"
    np.testing.assert_allclose(parts.sum(), here.slope, rtol=1e-7, atol=1e-8 * np.abs(parts).sum() + 1e-12)


def _worst(noise: float, here: _At, slope: Any, curvature: Any) -> tuple[float, str]:
    """The largest difference, as a share of what is allowed, and of which derivative it is."""
    off = abs(float(here.slope) - float(slope)) / (FIRST * abs(float(slope)) + noise * (1 + abs(float(here.value))))
    shares = [(off, "first derivative")]
    for by in curvature:
        leaves = zip(*map(jax.tree.leaves, (here.curvature[by], curvature[by], here.gradient[by])), strict=True)
        for found, expected, gradient in leaves:
            allowed = SECOND * _largest(expected) + noise * (1 + _largest(gradient))
            shares.append((_largest(found - expected) / allowed, f"second derivative, with {by},"))
    return max(shares)


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.slow if each.slow else ()) for name, each in MAKERS.items()]
)
def test_kernel(name: str) -> None:
    case = MAKERS[name].make()
    of = _Differentiator(case, partial(case.call, **case.constants))
    if case.carries:
        _check(case, of, case.carries)
    for title, (call, inputs) in case.near.items():
        print(title)
        other = of if call is None else _Differentiator(case, partial(call, **case.constants))
        _check(case, other, inputs, singular=True)
    if case.carries or case.constants:
        _check_constants(case)


def _check_constants(case: DerivativeCase) -> None:
    """By a constant, the derivative of everything is exactly zero; that of a constant result, by everything."""
    everything = case.carries | case.constants
    varying, fixed = jax.eval_shape(lambda inputs: _split(case.call(**inputs), case.constant_results), everything)
    assert len(fixed) == len(case.constant_results)
    assert bool(varying) or not case.carries

    def total(inputs: dict[str, Any], which: int) -> jax.Array:
        results = _split(case.call(**inputs), case.constant_results)[which]
        return sum((jnp.sum(jnp.sin(leaf)) for leaf in results), jnp.zeros(()))

    if case.constants and varying:
        gradient = quick_compile(jax.grad(lambda inputs: total(inputs, 0)))(everything)
        for constant in case.constants:
            assert not any(np.any(leaf) for leaf in jax.tree.leaves(gradient[constant])), constant
    if fixed:
        gradient = quick_compile(jax.grad(lambda inputs: total(inputs, 1)))(everything)
        assert not any(np.any(leaf) for leaf in jax.tree.leaves(gradient))


def test_every_kernel_and_argument_is_listed() -> None:
    """Those of the shapes that every kernel is checked with: no floating-point argument is left out."""
    shapes = kernel_cases.cases()
    assert MAKERS.keys() == shapes.keys()
    for name, each in MAKERS.items():
        case = each.make()
        listed = {label.partition(":")[0] for label in (*case.carries, *case.constants, *case.not_meant)}
        floating = {
            argument
            for argument, value in shapes[name].arguments.items()
            if any(jnp.issubdtype(leaf.dtype, jnp.floating) for leaf in jax.tree.leaves(value))
        }
        assert listed >= floating, name
