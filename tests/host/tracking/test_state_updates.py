"""Changes to the tracker's state from outside: what they change and what they leave."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxlie import SE3
from small_map import pose

from jaxslam.geometry.se3 import IDENTITY, between, compose, to_local, transform
from jaxslam.tracking.initial_state import init_state
from jaxslam.tracking.state import TrackPhase, TrackPlan, TrackState
from jaxslam.tracking.state_updates import apply_map_correction, load_keyframe, reset_at_pose

PLAN = TrackPlan(num_points=6, num_levels=2, num_keyframes=2, num_reloaded=2, num_sources=1, points_per_source=4)
HEIGHT, WIDTH, SLOTS = 24, 32, 4


@pytest.fixture(scope="module")
def state() -> Any:
    """A state full of numbers."""
    rng = np.random.default_rng(3)
    blank: Any = init_state(HEIGHT, WIDTH, PLAN, T_world_cam=SE3(jnp.asarray(pose(rng), jnp.float32)))
    fill = lambda array: jnp.asarray(rng.normal(size=array.shape), array.dtype)
    kept = jax.tree.map(fill, blank.keyframes)
    poses = np.stack([pose(rng) for _ in range(SLOTS)])
    kept = kept._replace(T_world_cam=jnp.asarray(poses, jnp.float32), weight=jnp.ones_like(kept.weight))
    points = jax.tree.map(fill, blank.points)._replace(valid=jnp.ones(PLAN.num_points, bool))
    return blank._replace(
        keyframes=kept, points=points, twist=jnp.ones(6, jnp.float32), phase=jnp.int32(TrackPhase.LOST)
    )


def parts(state: TrackState) -> dict[str, np.ndarray]:
    """Every array of a state by name."""
    plain: Any = state._replace(T_world_cam=state.T_world_cam.wxyz_xyz)  # type: ignore[arg-type]
    leaves = jax.tree_util.tree_flatten_with_path(plain)[0]
    return {jax.tree_util.keystr(path): np.asarray(leaf) for path, leaf in leaves}


def changed(before: TrackState, after: TrackState) -> set[str]:
    """Names of the arrays that differ; types and shapes never do."""
    old, new = parts(before), parts(after)
    assert {name: (array.shape, array.dtype) for name, array in old.items()} == {
        name: (array.shape, array.dtype) for name, array in new.items()
    }
    return {name for name in old if not np.array_equal(old[name], new[name])}


def float32(pose: np.ndarray) -> Any:
    return jnp.asarray(pose, jnp.float32)


class TestCarried:
    def test_identity(self, state: Any) -> None:
        identity = float32(IDENTITY)
        after = parts(apply_map_correction(state, identity, jnp.tile(identity, (SLOTS, 1))))
        for name, array in parts(state).items():
            np.testing.assert_allclose(after[name], array, atol=2e-7, err_msg=name)

    def test_rigid(self, state: Any) -> None:
        """Against float64 on the host: the camera and its points by one transform, each keyframe by its own."""
        rng = np.random.default_rng(4)
        now, each = pose(rng), np.stack([pose(rng) for _ in range(SLOTS)])
        after: Any = jax.jit(apply_map_correction)(state, float32(now), float32(each))
        assert changed(state, after) == {
            ".T_world_cam",
            ".points.X_world",
            ".points.X_anchor",
            ".keyframes.T_world_cam",
            ".keyframes.X_world",
        }
        apart = between(np.asarray(after.T_world_cam.wxyz_xyz), compose(now, np.asarray(state.T_world_cam.wxyz_xyz)))
        np.testing.assert_allclose(apart, IDENTITY, atol=1e-6)
        for moved, old in (
            (after.points.X_world, state.points.X_world),
            (after.points.X_anchor, state.points.X_anchor),
        ):
            np.testing.assert_allclose(moved, transform(now, np.asarray(old)), atol=3e-6)
        for slot, by in enumerate(each):
            kept, old = after.keyframes, state.keyframes
            apart = between(np.asarray(kept.T_world_cam[slot]), compose(by, np.asarray(old.T_world_cam[slot])))
            np.testing.assert_allclose(apart, IDENTITY, atol=1e-6)
            np.testing.assert_allclose(kept.X_world[slot], transform(by, np.asarray(old.X_world[slot])), atol=3e-6)

    def test_points_stay_where_they_are_seen(self, state: Any) -> None:
        """The same correction everywhere changes nothing that the camera can see."""
        change = pose(np.random.default_rng(5))
        after: Any = apply_map_correction(state, float32(change), jnp.tile(float32(change), (SLOTS, 1)))
        seen = lambda s: to_local(np.asarray(s.T_world_cam.wxyz_xyz, np.float64), np.asarray(s.points.X_world))
        np.testing.assert_allclose(seen(after), seen(state), atol=3e-6)


class TestRecalled:
    @pytest.mark.parametrize("slot", range(PLAN.num_keyframes, SLOTS))
    def test_fills_its_slot_alone(self, state: Any, slot: int) -> None:
        rng = np.random.default_rng(6)
        n = PLAN.num_points
        image = rng.integers(0, 256, (HEIGHT, WIDTH), np.uint8)
        uv, X_world, weight = (float32(rng.normal(size=shape)) for shape in ((2, n), (3, n), n))
        new = (jnp.asarray(image), float32(pose(rng)), uv, X_world, weight, -1 - jnp.arange(n))
        after: Any = load_keyframe(state, jnp.int32(slot), *new)
        names = ("images", "T_world_cam", "uv", "X_world", "weight", "id")
        assert changed(state, after) == {f".keyframes.{name}" for name in names}
        for name, array in zip(names, new, strict=True):
            there, before = np.asarray(getattr(after.keyframes, name)), np.asarray(getattr(state.keyframes, name))
            np.testing.assert_array_equal(there[slot], np.asarray(array).astype(there.dtype))
            np.testing.assert_array_equal(np.delete(there, slot, 0), np.delete(before, slot, 0))


class TestRelocated:
    def test_forgets_what_is_tied_to_the_old_place(self, state: Any) -> None:
        """Points and keyframes; the numbers of points and the places in the ring go on."""
        there = pose(np.random.default_rng(7))
        twist = float32(np.arange(1.0, 7.0))
        after: Any = reset_at_pose(state, float32(there), twist)
        assert changed(state, after) == {".T_world_cam", ".twist", ".points.valid", ".keyframes.weight", ".phase"}
        np.testing.assert_allclose(after.T_world_cam.wxyz_xyz, there, atol=1e-7)
        assert not np.asarray(after.points.valid).any()
        assert not np.asarray(after.keyframes.weight).any()
        np.testing.assert_array_equal(after.twist, twist)
        assert int(after.phase) == TrackPhase.START

    def test_keeps_keyframes_that_are_known_there(self, state: Any) -> None:
        there = pose(np.random.default_rng(7))
        after: Any = reset_at_pose(state, float32(there), float32(np.arange(1.0, 7.0)), keep_keyframes=True)
        assert changed(state, after) == {".T_world_cam", ".twist", ".points.valid", ".phase"}
