"""Two depth images compared: against a loop over pixels, and in scenes of a wall and a box whose answer is known."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from jaxlie import SE3
from jaxslam_kernels.camera import MIN_DEPTH, Intrinsics, make_intrinsics
from jaxslam_kernels.depth.depth_change import DepthChange, depth_change
from jaxslam_kernels.se3 import between, compose, retract
from quick_compile import quick_compile
from scipy.spatial.transform import Rotation

H, W, F = 24, 32, 40.0
CX, CY = (W - 1) / 2, (H - 1) / 2
SEEDS = st.integers(0, 2**32 - 1)
LIMITS = {"same_share": 0.04, "same_m": 0.0, "new_share": 0.1, "new_m": 0.0}
BOX = (slice(8, 15), slice(10, 17))
"""Rows and columns of a box 2 m away as the camera at rest sees it, before a wall 4 m away."""

_change = quick_compile(depth_change)


@pytest.fixture
def x64():
    with jax.enable_x64(True):
        yield


def _camera(dtype: Any = np.float32, fx=F, fy=F, cx=CX, cy=CY, distortion=()) -> Intrinsics:
    return make_intrinsics(fx, fy, cx, cy, distortion, dtype)


def _pose(rotation=(0, 0, 0), translation=(0, 0, 0), dtype: Any = np.float32) -> SE3:
    """A rotation vector in radians, and meters."""
    quaternion = Rotation.from_rotvec(rotation).as_quat(scalar_first=True)
    return SE3(jnp.asarray(np.concatenate([quaternion, translation]), dtype))


def _compare(depth, depth_then, T_then_now=None, camera=None, **limits) -> DepthChange:
    dtype = depth.dtype
    T_then_now = _pose(dtype=dtype) if T_then_now is None else T_then_now
    camera = _camera(dtype) if camera is None else camera
    return jax.tree.map(np.asarray, _change(depth, depth_then, T_then_now, camera, **limits))


def _images(seed=0, dtype: Any = np.float64, holes=0.1):
    """A slope, and another that is nearer in some blocks and farther in others; both noisy and with holes."""
    rng = np.random.default_rng(seed)
    v, u = np.mgrid[:H, :W]
    images = [2 + 0.02 * u + 0.03 * v + rng.normal(0, 0.02, (H, W)) for _ in range(2)]
    block = np.ones((H // 4, W // 4))
    images[1] += np.kron(rng.permutation(np.repeat([-0.8, -0.12, 0, 0.12, 0.8], [4, 1, 6, 1, 4])).reshape(4, 4), block)
    for image in images:
        image[rng.uniform(size=(H, W)) < holes] = 0
    return images[0].astype(dtype), images[1].astype(dtype)


def _random_pose(seed=0, dtype: Any = np.float64, rotation=0.1, translation=0.15) -> SE3:
    rng = np.random.default_rng([seed, 1])
    x, y, z = rng.uniform(-translation, translation, 3)
    return _pose(rng.uniform(-rotation, rotation, 3), (x, y, 0.2 * z), dtype)


class Reference(NamedTuple):
    """What the loop finds, where the earlier image has the pixel in view, and where a hair would change all that."""

    same: np.ndarray
    new: np.ndarray
    then: np.ndarray
    in_view: np.ndarray
    tie: np.ndarray


def _by_loop(depth, depth_then, T_then_now: SE3, camera: Intrinsics, margin: float, limits=LIMITS) -> Reference:
    """Pixel by pixel in double precision; ties are within `margin`, in pixels and as a share of the depth."""
    pose = np.asarray(T_then_now.wxyz_xyz, np.float64)
    R, t = Rotation.from_quat(pose[:4], scalar_first=True).as_matrix(), pose[4:]
    fx, fy, cx, cy = (float(value) for value in camera[:4])
    same, new, in_view, tie = (np.zeros((H, W), bool) for _ in range(4))
    then = np.zeros((H, W), int)
    for v, u in np.ndindex(H, W):
        z_now = float(depth[v, u])
        if not np.isfinite(z_now) or z_now <= MIN_DEPTH:
            continue
        x, y, z = R @ (np.array([(u - cx) / fx, (v - cy) / fy, 1]) * z_now) + t
        tie[v, u] |= abs(z - MIN_DEPTH) < margin
        if z <= MIN_DEPTH:
            continue
        at_u, at_v = fx * x / z + cx, fy * y / z + cy
        tie[v, u] |= any(abs(at - np.floor(at) - 0.5) < margin for at in (at_u, at_v))
        column, row = int(np.rint(at_u)), int(np.rint(at_v))
        if not (0 <= column < W and 0 <= row < H):
            continue
        in_view[v, u], then[v, u] = True, row * W + column
        seen = float(depth_then[row, column])
        if not np.isfinite(seen) or seen <= MIN_DEPTH:
            continue
        farther, alike = seen - z, limits["same_share"] * z + limits["same_m"]
        beyond = limits["new_share"] * z + limits["new_m"]
        tie[v, u] |= min(abs(abs(farther) - alike), abs(farther - beyond)) < margin * z
        same[v, u], new[v, u] = abs(farther) < alike, farther > beyond
    return Reference(same, new, then, in_view, tie)


def _scene(eye=(0, 0, 0), rotation=(0, 0, 0), box=True, dtype: Any = np.float32):
    """Depth of a wall 4 m in front of the origin, and the box, from a camera somewhere."""
    v, u = np.mgrid[:H, :W]
    rays = np.stack([(u - CX) / F, (v - CY) / F, np.ones((H, W))]).reshape(3, -1)
    x, y, z = Rotation.from_rotvec(rotation).as_matrix() @ rays
    wall, front = (4 - eye[2]) / z, (2 - eye[2]) / z
    row, column = F * (eye[1] + front * y) / 2 + CY, F * (eye[0] + front * x) / 2 + CX
    hit = (row > BOX[0].start - 0.5) & (row < BOX[0].stop - 0.5)
    hit &= (column > BOX[1].start - 0.5) & (column < BOX[1].stop - 0.5)
    return np.where(hit & box, front, wall).reshape(H, W).astype(dtype)


def _box_pixels() -> np.ndarray:
    pixels = np.zeros((H, W), bool)
    pixels[BOX] = True
    return pixels


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_shapes(dtype):
    with jax.enable_x64(dtype == np.float64):
        change = _compare(*_images(dtype=dtype), _random_pose(dtype=dtype))
        limits = {name: jnp.asarray(value, dtype) for name, value in LIMITS.items()}
        again = _compare(*_images(dtype=dtype), _random_pose(dtype=dtype), **limits)
    assert change.same.shape == change.new.shape == change.then.shape == (H, W)
    assert change.same.dtype == change.new.dtype == bool
    assert change.then.dtype == np.int32
    jax.tree.map(np.testing.assert_array_equal, change, again)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize(("dtype", "margin"), [(np.float32, 1e-4), (np.float64, 1e-10)])
def test_matches_reference(dtype, margin, seed):
    """Everywhere but at ties, of which there are few; the camera stretches the picture unequally."""
    with jax.enable_x64(dtype == np.float64):
        images, T = _images(seed, dtype), _random_pose(seed, dtype)
        camera = _camera(dtype, fx=42.0, fy=37.0, cx=14.2, cy=12.7)
        limits = LIMITS if seed % 2 else {"same_share": 0.02, "same_m": 0.05, "new_share": 0.15, "new_m": 0.05}
        change = _compare(*images, T, camera, **({} if seed % 2 else limits))
        expected = _by_loop(*images, T, camera, margin, limits)
    clear, in_view = ~expected.tie, expected.in_view & ~expected.tie
    assert expected.tie.sum() <= (5 if dtype == np.float32 else 0)
    assert min(expected.same.sum(), expected.new.sum()) > 50
    assert (in_view & ~expected.same & ~expected.new).sum() > 50
    np.testing.assert_array_equal(change.same[clear], expected.same[clear])
    np.testing.assert_array_equal(change.new[clear], expected.new[clear])
    np.testing.assert_array_equal(change.then[in_view], expected.then[in_view])


class TestScenes:
    @pytest.mark.parametrize("box", [False, True])
    def test_at_rest_and_nothing_moved(self, box):
        change = _compare(_scene(box=box), _scene(box=box))
        assert change.same.all()
        assert not change.new.any()
        np.testing.assert_array_equal(change.then.ravel(), np.arange(H * W))

    def test_a_box_put_in_front(self):
        change = _compare(_scene(box=True), _scene(box=False))
        np.testing.assert_array_equal(change.new, _box_pixels())
        np.testing.assert_array_equal(change.same, ~_box_pixels())

    def test_a_box_taken_away(self):
        """The wall behind it was hidden: perhaps it has been there all the time."""
        change = _compare(_scene(box=False), _scene(box=True))
        assert not change.new.any()
        np.testing.assert_array_equal(change.same, ~_box_pixels())

    @pytest.mark.parametrize("missing", [0, -1, np.nan, np.inf, -np.inf, MIN_DEPTH / 2])
    def test_depth_missing_now_or_then(self, missing):
        for k in range(2):
            images = [_scene(box=True), _scene(box=False)]
            images[k][:, 12:14] = missing
            change = _compare(*images)
            known = np.ones((H, W), bool)
            known[:, 12:14] = False
            np.testing.assert_array_equal(change.new, _box_pixels() & known)
            np.testing.assert_array_equal(change.same, ~_box_pixels() & known)

    @pytest.mark.parametrize("missing", [0, -1, np.nan, np.inf, -np.inf, MIN_DEPTH / 2])
    def test_depth_missing_whatever_the_limits(self, missing):
        """Nor does the place that a missing depth would have after the camera has moved."""
        T, columns = _pose(translation=(0, 0, 1)), np.broadcast_to(np.arange(W), (H, W))
        for k in range(2):
            now, then = images = _scene((0, 0, 1), box=False), _scene(box=False)
            images[k][:, 12:14] = missing
            change = _compare(now, then, T, same_m=100.0, new_m=-100.0)
            known = ~np.isin(change.then % W if k else columns, (12, 13))
            np.testing.assert_array_equal(change.same, known)
            np.testing.assert_array_equal(change.new, known)

    @pytest.mark.parametrize("box", [False, True])
    def test_along_the_wall(self, box):
        """By half a meter to the right, 5 pixels of the wall and 10 of the box."""
        change = _compare(_scene((0.5, 0, 0), box=box), _scene(box=box), _pose(translation=(0.5, 0, 0)))
        columns = np.broadcast_to(np.arange(W), (H, W))
        moved_box = np.roll(_box_pixels(), -10, axis=1) & box
        hidden = np.roll(_box_pixels(), -5, axis=1) & box & ~moved_box
        assert not change.new.any()
        np.testing.assert_array_equal(change.same, (columns < W - 5) & ~hidden)
        shift = np.where(moved_box, 10, 5)
        np.testing.assert_array_equal((change.then % W - columns)[change.same], shift[change.same])
        np.testing.assert_array_equal((change.then // W)[change.same], np.mgrid[:H, :W][0][change.same])

    def test_along_the_wall_and_a_box_put_in_front(self):
        change = _compare(_scene((0, 0.3, 0)), _scene(box=False), _pose(translation=(0, 0.3, 0)))
        moved_box = np.roll(_box_pixels(), -6, axis=0)
        np.testing.assert_array_equal(change.new, moved_box)
        np.testing.assert_array_equal(change.same, ~moved_box & (np.mgrid[:H, :W][0] < H - 3))

    def test_towards_the_wall(self):
        """A meter nearer than before, and every depth a meter less."""
        change = _compare(_scene((0, 0, 1), box=False), _scene(box=False), _pose(translation=(0, 0, 1)))
        assert change.same.all()
        assert change.then.min() == (H // 2 - 9) * W + W // 2 - 12  # three quarters of the 11.5 rows and 15.5 columns
        away = _compare(_scene((0, 0, -1), box=False), _scene(box=False), _pose(translation=(0, 0, -1)))
        row, column = np.mgrid[:H, :W]
        inside = (np.abs(row - CY) < H / 2.5) & (np.abs(column - CX) < W / 2.5)
        np.testing.assert_array_equal(away.same, inside)
        assert not away.new.any()

    @pytest.mark.parametrize("axis", [0, 1, 2])
    def test_turned(self, axis):
        """About every axis, with and without the box: the same where it is in view and not hidden."""
        rotation, eye = 0.15 * np.eye(3)[axis], (0.1, -0.05, 0.2)
        now, T = _scene(eye, rotation), _pose(rotation, eye)
        there, not_there = _compare(now, _scene(), T), _compare(now, _scene(box=False), T)
        box = (now < 3) & (there.same | there.new)
        assert box.sum() > 30
        assert (not_there.new == (now < 3)).all()
        assert not_there.same[now > 3].sum() > 300
        assert there.same[box].mean() > 0.7  # not at its edges, where the nearest pixel is of the wall
        np.testing.assert_array_equal(there.same | there.new, there.same | (now < 3))

    def test_upside_down(self):
        T = _pose((0, 0, np.pi))
        change = _compare(_scene()[::-1, ::-1], _scene(), T)
        assert change.same.all()
        np.testing.assert_array_equal(change.then.ravel(), np.arange(H * W)[::-1])

    @pytest.mark.parametrize(
        "T",
        [
            _pose(translation=(9, 0, 0)),
            _pose(translation=(-9, 0, 0)),
            _pose(translation=(0, 9, 0)),
            _pose(translation=(0, -9, 0)),
            _pose((0, np.pi, 0)),
            _pose((np.pi, 0, 0)),
            _pose(translation=(0, 0, -9)),
        ],
        ids=["right", "left", "below", "above", "behind", "behind, upside down", "passed by"],
    )
    def test_out_of_view(self, T):
        change = _compare(_scene(), _scene(), T)
        assert not change.same.any()
        assert not change.new.any()
        assert ((change.then >= 0) & (change.then < H * W)).all()

    def test_half_a_pixel_outside_is_inside(self):
        """The outer halves of the outermost pixels are in view, and nothing farther out."""
        wall = np.full((H, W), 4, np.float32)
        for sign in (-1, 1):
            for shift, seen in ((0.45, W), (0.55, W - 1)):
                change = _compare(wall, wall, _pose(translation=(sign * shift * 4 / F, 0, 0)))
                np.testing.assert_array_equal(change.same.sum(axis=1), seen)
            for shift, seen in ((0.45, H), (0.55, H - 1)):
                change = _compare(wall, wall, _pose(translation=(0, sign * shift * 4 / F, 0)))
                np.testing.assert_array_equal(change.same.sum(axis=0), seen)

    def test_distortion_is_left_out(self):
        images, T = _images(dtype=np.float32), _random_pose(dtype=np.float32)
        lens = _camera(distortion=(-0.3, 0.2, 0.01, 0.01, 0.1))
        jax.tree.map(np.testing.assert_array_equal, _compare(*images, T, lens), _compare(*images, T))


@pytest.mark.parametrize(
    ("limits", "meters", "alike", "beyond"),
    [
        ({}, 2, 0.08, 0.2),
        ({}, 6, 0.24, 0.6),
        ({"same_share": 0.1, "new_share": 0.2}, 2, 0.2, 0.4),
        ({"same_m": 0.1, "new_m": 0.3}, 4, 0.26, 0.7),
    ],
)
def test_limits(limits, meters, alike, beyond):
    """They grow with the distance from the earlier camera, from where the wall is a meter nearer or farther."""
    for ahead in (-1, 0, 1):
        depth, T = np.full((H, W), meters - ahead, np.float32), _pose(translation=(0, 0, ahead))
        for difference, same, new in (
            (alike - 0.001, True, False),
            (0.001 - alike, True, False),
            (alike + 0.001, False, False),
            (-0.001 - alike, False, False),
            (beyond - 0.001, False, False),
            (beyond + 0.001, False, True),
            (-beyond - 0.001, False, False),
        ):
            change = _compare(depth, np.full((H, W), meters + difference, np.float32), T, **limits)
            center = H // 2, W // 2
            assert (change.same[center], change.new[center]) == (same, new), (ahead, difference)


def _sum_of(images, change: DepthChange):
    """Ratios of the depths now and then, each with a weight of its own: what a comparison is used for, given it."""
    depth, depth_then = images
    said = change.same | change.new
    seen = jnp.where(said, depth_then.reshape(-1)[change.then], 1)
    now = jnp.where(said, depth, 1)
    weight = 1 + jnp.arange(H * W, dtype=depth.dtype).reshape(H, W) / (H * W)
    return (weight * jnp.where(change.same, now / seen, jnp.where(change.new, seen / now, 0))).sum()


def _loss(images, T_then_now, tangent, camera, limits):
    depth, depth_then = images
    return _sum_of(images, depth_change(depth, depth_then, retract(T_then_now, tangent), camera, **limits))


_gradient_at_change = quick_compile(jax.grad(_sum_of))
_value_and_gradient = quick_compile(jax.value_and_grad(_loss, argnums=(0, 2, 3, 4)))


@quick_compile
def _jvp(T, point, direction):
    loss = lambda images, tangent, camera, limits: _loss(images, T, tangent, camera, limits)
    return jax.jvp(loss, point, direction)[1]


@pytest.mark.parametrize(
    ("T", "said"),
    [(((0.1, -0.05, 0.08), (0.1, 0.05, -0.1)), 300), ((), 300), (((0, np.pi / 2, 0),), 0), (((0, np.pi, 0),), 0)],
    ids=["moved", "at rest", "in the plane of the camera", "behind"],
)
def test_gradient(x64, T, said):
    """The choice is constant: forward, reverse, finite differences and the gradient at a given choice agree.

    The earlier camera's pose, the lens and the limits have none; also where points are at no distance from the camera.
    """
    images, T = _images(), _pose(*T, dtype=np.float64)
    camera = _camera(np.float64, cx=16.0)
    limits = {name: jnp.asarray(value) for name, value in LIMITS.items()}
    point = (images, jnp.zeros(6), camera, limits)
    at = lambda point: _value_and_gradient(point[0], T, *point[1:])
    random = np.random.default_rng(3)
    direction = jax.tree.map(lambda x: jnp.asarray(random.normal(size=np.shape(x))), point)
    _, (gradient, *without) = at(point)
    forward = _jvp(T, point, direction)
    ahead, behind = (at(jax.tree.map(lambda x, d, h=h: x + h * d, point, direction))[0] for h in (1e-7, -1e-7))
    change = _compare(*images, T, camera)
    expected = _gradient_at_change(images, change)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-12), gradient, expected)
    reverse = sum(float((g * d).sum()) for g, d in zip(gradient, direction[0], strict=True))
    np.testing.assert_allclose(forward, reverse, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(forward, (ahead - behind) / 2e-7, rtol=1e-6, atol=1e-6)
    assert (abs(reverse) > 0.1) == (said > 0)
    assert (change.same | change.new).sum() >= said
    jax.tree.map(lambda g: np.testing.assert_array_equal(g, 0), without)


def test_vmap_equals_loop(x64):
    pairs = [_images(seed) for seed in range(3)]
    now, then = (np.stack(images) for images in zip(*pairs, strict=True))
    poses = [_random_pose(seed) for seed in range(3)]
    cameras = [_camera(np.float64, fx=F + seed, cy=CY - seed) for seed in range(3)]
    T, camera = (jax.tree.map(lambda *parts: jnp.stack(parts), *parts) for parts in (poses, cameras))
    batched = quick_compile(jax.vmap(depth_change))(now, then, T, camera)
    several = quick_compile(jax.vmap(depth_change, in_axes=(None, 0, 0, None)))(now[0], then, T, cameras[0])
    for k in range(3):
        one = _compare(now[k], then[k], poses[k], cameras[k])
        other = _compare(now[0], then[k], poses[k], cameras[0])
        assert min(one.same.sum(), one.new.sum(), other.same.sum(), other.new.sum()) > 50
        jax.tree.map(lambda a, b, k=k: np.testing.assert_array_equal(a[k], b), batched, one)
        jax.tree.map(lambda a, b, k=k: np.testing.assert_array_equal(a[k], b), several, other)


def test_single_trace():
    traced = quick_compile(eqx.debug.assert_max_traces(depth_change, max_traces=1))
    for seed in range(3):
        images, T = _images(seed, np.float32), _random_pose(seed, np.float32)
        traced(*images, T, _camera(fx=F + seed), same_m=0.01 * seed, new_share=0.1 * seed)


_NONE = {"T": _pose(), "camera": _camera(), "expected": False}
DEGENERATE: dict[str, dict[str, Any]] = {  # changes of a wall in front of a camera at rest, and what is the same
    "nothing missing": {"expected": True},
    "no depth": {"now": 0},
    "no depth then": {"then": 0},
    "no depth at all": {"now": 0, "then": 0},
    "NaN": {"now": np.nan},
    "NaN then": {"then": np.nan},
    "NaN both": {"now": np.nan, "then": np.nan},
    "infinite": {"now": np.inf},
    "infinite then": {"then": np.inf},
    "infinite both": {"now": np.inf, "then": np.inf},
    "negative": {"now": -2, "then": -2},
    "at the lens": {"now": 1e-30, "then": 1e-30},
    "far, and the pixel overflows": {"now": 3e38, "then": 3e38, "T": _pose((0, 0.1, 0)), "expected": None},
    "behind": {"T": _pose((0, np.pi, 0))},
    "at the earlier camera": {"T": _pose(translation=(0, 0, -2))},
    "far away": {"T": _pose(translation=(1e30, 0, 0))},
    "far ahead": {"T": _pose(translation=(0, 0, 1e30))},
    "far behind": {"T": _pose(translation=(1e30, -1e30, -1e30))},
    "pose overflows": {"T": _pose(translation=(3e38, 3e38, 3e38))},
    "pose NaN": {"T": SE3(jnp.full(7, jnp.nan))},
    "position NaN": {"T": _pose(translation=(np.nan, 0, 0))},
    "position infinite": {"T": _pose(translation=(0, np.inf, np.inf))},
    "rotation zero": {"T": SE3(jnp.zeros(7)), "expected": None},
    "focal length 0": {"camera": _camera(fx=0.0, fy=0.0)},
    "focal length NaN": {"camera": _camera(fx=np.nan)},
    "focal length infinite": {"camera": _camera(fy=np.inf)},
    "center infinite": {"camera": _camera(cx=np.inf)},
    "limits 0": {"limits": dict.fromkeys(LIMITS, 0.0)},
    "limits NaN": {"limits": dict.fromkeys(LIMITS, np.nan)},
    "limits negative": {"then": 1.9, "limits": {"same_share": -1.0, "same_m": -1.0}},
}


@pytest.mark.parametrize("case", DEGENERATE)
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.filterwarnings("ignore:overflow encountered in cast:RuntimeWarning")
def test_degenerate(case, dtype):
    """Nothing is said, every index is one of a pixel, and derivatives are finite."""
    given = {"now": 2, "then": 2, "limits": {}} | _NONE | DEGENERATE[case]
    images = np.full((H, W), given["now"], dtype), np.full((H, W), given["then"], dtype)
    with jax.enable_x64(dtype == np.float64):
        T, camera = jax.tree.map(lambda x: jnp.asarray(x, dtype), (given["T"], given["camera"]))
        limits = {name: jnp.asarray(value, dtype) for name, value in (LIMITS | given["limits"]).items()}
        change = _compare(*images, T, camera, **limits)
        gradients = _value_and_gradient(images, T, jnp.zeros(6, dtype), camera, limits)[1]
    if given["expected"] is not None:
        np.testing.assert_array_equal(change.same, given["expected"])
    assert not change.new.any()
    assert ((change.then >= 0) & (change.then < H * W)).all()
    assert change.then.dtype == np.int32
    assert all(np.isfinite(gradient).all() for gradient in jax.tree.leaves(gradients))


@pytest.mark.parametrize("value", [2.0, 0.0, np.nan, np.inf])
def test_one_pixel(value):
    """On the optical axis, in a camera of one."""
    camera = _camera(cx=0.0, cy=0.0)
    image, now = np.full((1, 1), value, np.float32), np.full((1, 1), 1.5, np.float32)
    change = _compare(image, image, camera=camera)
    assert (change.same.item(), change.new.item(), change.then.item()) == (value == 2, False, 0)
    change = _compare(now, image, camera=camera)
    assert (change.same.item(), change.new.item(), change.then.item()) == (False, value == 2, 0)
    assert not _compare(now, image, _pose(translation=(1, 0, 0)), camera).new.any()


def test_no_pixel():
    change = _compare(np.zeros((0, W), np.float32), np.zeros((0, W), np.float32))
    assert change.same.shape == change.new.shape == change.then.shape == (0, W)


def _wild(seed, holes=0.2):
    """Depths of any size, with every kind of hole."""
    rng = np.random.default_rng(seed)
    images = np.exp(rng.uniform(np.log(0.02), np.log(50), (2, H, W)))
    images[1] = np.where(rng.uniform(size=(H, W)) < 0.3, images[0] * rng.uniform(0.9, 1.2, (H, W)), images[1])
    filling = rng.choice([0, -1, np.nan, np.inf, -np.inf, 1e-30, MIN_DEPTH], images.shape)
    return np.where(rng.uniform(size=images.shape) < holes, filling, images).astype(np.float32)


_SHARES, _METERS = st.floats(0, 0.5, width=32), st.floats(0, 1, width=32)


@settings(max_examples=30, deadline=None, derandomize=True)
@given(seed=SEEDS, angle=st.floats(0, 4), shares=st.tuples(_SHARES, _SHARES), meters=st.tuples(_METERS, _METERS))
def test_nothing_is_both_same_and_new(seed, angle, shares, meters):
    """Whatever the depths, the pose, and limits of which those of what is new are the greater ones."""
    (same_share, new_share), (same_m, new_m) = sorted(shares), sorted(meters)
    now, then = _wild(seed)
    T = _random_pose(seed, np.float32, rotation=angle, translation=3)
    limits = {"same_share": same_share, "same_m": same_m, "new_share": new_share, "new_m": new_m}
    change = _compare(now, then, T, **{name: np.float32(value) for name, value in limits.items()})
    assert not (change.same & change.new).any()
    assert ((change.then >= 0) & (change.then < H * W)).all()
    said = change.same | change.new
    for depth in (now[said], then.ravel()[change.then[said]]):
        assert (np.isfinite(depth) & (depth > MIN_DEPTH)).all()


@settings(max_examples=20, deadline=None, derandomize=True)
@given(seed=SEEDS, angle=st.floats(-3, 3), offset=st.floats(-100, 100))
def test_rigid_motion_of_the_world_does_not_matter(seed, angle, offset):
    """Nor does the sign of the quaternion."""
    with jax.enable_x64(True):
        images, T_world_then, T_then_now = _images(seed), _random_pose(seed + 1), _random_pose(seed)
        T_world_now = compose(T_world_then, T_then_now)
        change = _compare(*images, between(T_world_then, T_world_now))
        W_new_old = _pose(angle * np.array([0.6, 0, 0.8]), (offset, 2 * offset, -offset), np.float64)
        again = between(compose(W_new_old, T_world_then), compose(W_new_old, T_world_now))
        sign = jnp.where(jnp.arange(7) < 4, -1.0, 1.0)
        clear = ~_by_loop(*images, T_then_now, _camera(np.float64), 1e-9).tie
        assert clear.mean() > 0.99
        for other in (_compare(*images, again), _compare(*images, SE3(sign * again.wxyz_xyz))):
            jax.tree.map(lambda a, b: np.testing.assert_array_equal(a[clear], b[clear]), other, change)


@settings(max_examples=20, deadline=None, derandomize=True)
@given(seed=SEEDS, power=st.integers(-3, 5))
def test_scale_does_not_matter(seed, power):
    """Of all lengths together, the limits in meters included; by powers of two, so that nothing is rounded anew."""
    scale = np.float32(2.0**power)
    now, then = _images(seed, np.float32)
    T = _random_pose(seed, np.float32)
    larger = SE3(T.wxyz_xyz * jnp.where(jnp.arange(7) < 4, jnp.float32(1), scale))
    limits = {"same_m": np.float32(0.02), "new_m": np.float32(0.15)}
    change = _compare(now, then, T, **limits)
    again = _compare(scale * now, scale * then, larger, **{name: scale * value for name, value in limits.items()})
    jax.tree.map(np.testing.assert_array_equal, again, change)


@settings(max_examples=20, deadline=None, derandomize=True)
@given(seed=SEEDS, upside_down=st.booleans())
def test_exchanged(seed, upside_down):
    """With the two images exchanged, what was new was hidden, what was hidden is new, and what is the same stays."""
    turn = (slice(None, None, -1),) * 2 if upside_down else (slice(None),) * 2
    T = SE3(jnp.asarray([0, 0, 0, 1, 0, 0, 0] if upside_down else [1, 0, 0, 0, 0, 0, 0], jnp.float32))
    limits = {"same_share": 0.0, "same_m": 0.2, "new_share": 0.0, "new_m": 0.2}
    now, then = _images(seed, np.float32)
    known = (now > 0) & (then[turn] > 0)
    change, exchanged = _compare(now, then, T, **limits), _compare(then, now, T, **limits)
    same, new = exchanged.same[turn], exchanged.new[turn]
    np.testing.assert_array_equal(change.same, same)
    np.testing.assert_array_equal(change.same.astype(int) + change.new + new, known)
    assert min(change.same.sum(), change.new.sum(), new.sum()) > 10
    usual, exchanged = _compare(now, then, T), _compare(then, now, T)
    assert not (usual.new & (exchanged.same | exchanged.new)[turn]).any()


@settings(max_examples=20, deadline=None, derandomize=True)
@given(seed=SEEDS, missing=st.sampled_from([0.0, -1.0, np.nan, np.inf, -np.inf]))
def test_holes_do_not_matter_elsewhere(seed, missing):
    """A hole, now or then, takes back what was said of its own pixel, and nothing else."""
    now, then = _images(seed, np.float32, holes=0)
    T, rng = _random_pose(seed, np.float32), np.random.default_rng(seed)
    hole_now, hole_then = rng.uniform(size=(2, H, W)) < 0.2
    before = _compare(now, then, T)
    after = _compare(np.where(hole_now, missing, now), np.where(hole_then, missing, then).astype(np.float32), T)
    left = ~hole_now & ~hole_then.ravel()[before.then]
    np.testing.assert_array_equal(after.same, before.same & left)
    np.testing.assert_array_equal(after.new, before.new & left)
    np.testing.assert_array_equal(after.then[~hole_now], before.then[~hole_now])


@settings(max_examples=20, deadline=None, derandomize=True)
@given(seed=SEEDS, farther=st.floats(0, 3))
def test_what_is_new_stays_new_if_more_was_free(seed, farther):
    """With all that was seen then farther away, nothing new ceases to be."""
    now, then = _images(seed, np.float32)
    T = _random_pose(seed, np.float32)
    before = _compare(now, then, T)
    after = _compare(now, np.where(then > 0, then + np.float32(farther), then), T)
    assert before.new.any()
    assert (after.new | ~before.new).all()
    assert not (after.same & before.new).any()
