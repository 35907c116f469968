"""Pyramids against OpenCV's."""

from functools import partial

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from equinox.debug import assert_max_traces
from jax.test_util import check_grads
from jaxslam_kernels.image.pyramid import build_pyramid, half_size
from quick_compile import quick_compile


@pytest.fixture
def x64():
    with jax.enable_x64(True):
        yield


def _image(height, width, dtype: type = np.float64, seed=0):
    return np.random.default_rng(seed).uniform(0, 255, (height, width)).astype(dtype)


_build = jax.jit(lambda image: build_pyramid(image, num_levels=3, border=8))
SIZE = (37, 52)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_shapes(dtype):
    with jax.enable_x64(dtype == np.float64):
        pyramid = _build(_image(*SIZE, dtype))
    assert [level.shape for level in pyramid.levels] == [(37 + 16, 52 + 16), (19 + 16, 26 + 16), (10 + 16, 13 + 16)]
    assert all(level.dtype == dtype for level in pyramid.levels)
    assert [pyramid.size(level) for level in range(3)] == [(37, 52), (19, 26), (10, 13)]


@pytest.mark.parametrize(("given", "expected"), [(None, np.float32), (np.float64, np.float64)])
def test_whole_numbers_equal_the_same_in_floating_point(x64, given, expected):
    image = _image(*SIZE).astype(np.uint8)
    build = quick_compile(partial(build_pyramid, num_levels=3, dtype=given))
    pyramid, same = build(jnp.asarray(image)), build(jnp.asarray(image, expected))
    for level, reference in zip(pyramid.levels, same.levels, strict=True):
        assert level.dtype == expected
        np.testing.assert_array_equal(level, reference)


@pytest.mark.parametrize("size", [SIZE, (36, 52), (3, 4)])
def test_matches_reference(x64, size):
    image = _image(*size)
    np.testing.assert_allclose(half_size(jnp.asarray(image)), cv2.pyrDown(image), rtol=1e-13)


def test_matches_reference_of_pyramids(x64):
    image = _image(*SIZE).astype(np.uint8)
    _, levels = cv2.buildOpticalFlowPyramid(image, (8, 8), 2, withDerivatives=False)
    pyramid = _build(image.astype(float))
    for number, expected in enumerate(levels):
        height, width = expected.shape
        inner = pyramid.levels[number][8 : 8 + height, 8 : 8 + width]
        np.testing.assert_allclose(inner, expected, atol=0.5 * number)  # OpenCV rounds once a level


def test_border_repeats_the_edge():
    pyramid = _build(_image(*SIZE, np.float32))
    for level in pyramid.levels:
        np.testing.assert_array_equal(level, np.pad(level[8:-8, 8:-8], 8, mode="edge"))


def test_gradient(x64):
    image, direction = jnp.asarray(_image(*SIZE)), jnp.asarray(_image(*SIZE, seed=1))
    check_grads(_build, (image,), order=1, modes=("fwd", "rev"), eps=1e-3, rtol=1e-8)
    tangent = jax.jvp(_build, (image,), (direction,))[1]
    for linear, expected in zip(tangent.levels, _build(direction).levels, strict=True):
        np.testing.assert_allclose(linear, expected, rtol=1e-12)


def test_vmap_equals_loop():
    images = np.stack([_image(*SIZE, np.float32, seed) for seed in range(3)])
    batch = jax.vmap(_build)(images)
    for index, image in enumerate(images):
        for level, expected in zip(batch.levels, _build(image).levels, strict=True):
            np.testing.assert_allclose(level[index], expected, rtol=1e-6)


def test_single_trace():
    build = jax.jit(assert_max_traces(build_pyramid, max_traces=1))
    for seed in range(3):
        build(_image(*SIZE, np.float32, seed))


def test_degenerate():
    constant = _build(np.full(SIZE, 100, np.float32))
    assert all(np.all(level == 100) for level in constant.levels)
    one = build_pyramid(jnp.asarray(_image(1, 1, np.float32)), num_levels=1, border=2)
    assert one.levels[0].shape == (5, 5)


def test_nan_stays_near(x64):
    """A pixel that is not a number spoils what is computed from it, and nothing else."""
    image = _image(*SIZE)
    clean, bad = _build(image), image.copy()
    bad[20, 30] = np.nan
    for number, (level, expected) in enumerate(zip(_build(bad).levels, clean.levels, strict=True)):
        spoilt = np.argwhere(~np.isfinite(level)) - 8
        assert len(spoilt)
        assert np.all(np.abs(spoilt * 2**number - [20, 30]) <= 2 * (2**number - 1))
        kept = np.isfinite(level)
        np.testing.assert_array_equal(level[kept], expected[kept])


@pytest.mark.parametrize(("size", "num_levels"), [((37, 52), 0), ((8, 52), 4), ((2, 2), 2)])
def test_refuses_impossible_levels(size, num_levels):
    with pytest.raises(ValueError, match="num_levels"):
        build_pyramid(jnp.zeros(size), num_levels=num_levels)
