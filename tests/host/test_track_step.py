"""`track_step` as a pure function: compiled or not, batched, scanned, traced once, in both precisions."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax
from small_scene import PLAN, QUICK_COMPILE, at, clip, new_state, params, stacked

from jaxslam.frame_arrays import FrameArrays
from jaxslam.state import TrackOutput, TrackParams, TrackState, TrackStatus
from jaxslam.track import track_step

COUNT = 12
SAME = {"twist": 1e-4 * 30, "covariance": 1e-7, "looked_up.uv": 1e-2}
"""What is the same number in metres a second and square metres, where poses are the same to 1e-4.

Rounding decides whether the refinement takes its last step: compiled in another way, poses differ by 0 or by 5e-6 m.
So it does for the search of a point that is looked up, whose last step is up to 0.05 px long.
"""

Step = Callable[[TrackState, FrameArrays, TrackParams], tuple[TrackState, TrackOutput]]


class Counted:
    """`track_step`, compiled, with its traces counted."""

    def __init__(self) -> None:
        self.traces = 0
        self.step: Step = jax.jit(self._trace, compiler_options=QUICK_COMPILE)

    def _trace(self, state: TrackState, frame: FrameArrays, params: TrackParams) -> tuple[TrackState, TrackOutput]:
        self.traces += 1
        return track_step(state, frame, params, PLAN)


@pytest.fixture(scope="module")
def counted() -> Counted:
    return Counted()


@pytest.fixture(scope="module")
def frames() -> FrameArrays:
    return stacked(clip(2).frames[:COUNT])


def track(step: Step, frames: FrameArrays, seed: int = 0, **changes: Any) -> tuple[TrackState, list[TrackOutput]]:
    state, outputs = new_state(seed=seed), []
    for index in range(COUNT):
        state, output = step(state, at(frames, index), params()._replace(**changes))
        outputs.append(output)
    return state, outputs


def poses(outputs: list[TrackOutput]) -> np.ndarray:
    return np.array([output.T_world_cam.wxyz_xyz for output in outputs])


def described(tree: Any) -> list[tuple[tuple[int, ...], Any]]:
    return [(leaf.shape, leaf.dtype) for leaf in jax.tree.leaves(tree)]


def numbers(result: tuple[TrackState, TrackOutput]) -> tuple[TrackState, TrackOutput]:
    """The result in NumPy arrays, the random key as the integers it is made of."""
    state, output = result
    return jax.device_get((state._replace(key=jax.random.key_data(state.key)), output))


class TestShapes:
    @pytest.mark.parametrize("dtype", [np.float32, np.float64])
    def test_state_keeps_shapes_and_types(self, dtype: type[np.floating]) -> None:
        recording = clip()
        with jax.enable_x64(dtype is np.float64):
            state = new_state(dtype)
            frame = at(stacked(recording.frames[:1], dtype), 0)
            after, output = jax.eval_shape(lambda s, f, p: track_step(s, f, p, PLAN), state, frame, params(dtype))
            assert jax.tree.structure(after) == jax.tree.structure(state)
            assert described(after) == described(state)
            assert output.T_world_cam.wxyz_xyz.dtype == dtype
            assert output.covariance.shape == (6, 6)
            assert output.uv.shape == (2, PLAN.num_points)


class TestCompiled:
    def test_tracks(self, counted: Counted, frames: FrameArrays) -> None:
        state, outputs = track(counted.step, frames)
        statuses = [int(output.status) for output in outputs]
        assert statuses == [TrackStatus.STARTED] + [TrackStatus.OK] * (COUNT - 1)
        assert int(state.frame) == COUNT

    def test_single_trace(self, counted: Counted, frames: FrameArrays) -> None:
        track(counted.step, frames)
        track(counted.step, frames, seed=7, loss_scale=jnp.float32(2.0), readout_s=jnp.float32(0.01))
        assert counted.traces == 1

    def test_same_bytes_again(self, counted: Counted, frames: FrameArrays) -> None:
        first, second = (track(counted.step, frames) for _ in range(2))
        np.testing.assert_array_equal(poses(first[1]), poses(second[1]))

    def test_equals_uncompiled(self, counted: Counted, frames: FrameArrays) -> None:
        """Operation by operation, without `jit` around them, on a frame that has points, velocity and keyframes."""
        before, step = new_state(), 5
        for index in range(step):
            before, _ = counted.step(before, at(frames, index), params())
        compiled = counted.step(before, at(frames, step), params())
        directly = track_step(before, at(frames, step), params(), PLAN)
        assert int(compiled[1].status) == TrackStatus.OK
        assert int(compiled[1].num_looked_up) > 0
        assert jax.tree.structure(directly) == jax.tree.structure(compiled)
        for (path, one), other in zip(
            jax.tree_util.tree_leaves_with_path(numbers(directly)), jax.tree.leaves(numbers(compiled)), strict=True
        ):
            name = jax.tree_util.keystr(path)
            assert one.dtype == other.dtype, name
            if np.issubdtype(one.dtype, np.floating):
                field = "looked_up.uv" if name.endswith("looked_up.uv") else name.split(".")[-1]
                np.testing.assert_allclose(one, other, rtol=1e-5, atol=SAME.get(field, 1e-4), err_msg=name)
            else:
                np.testing.assert_array_equal(one, other, err_msg=name)

    def test_scan_equals_loop(self, counted: Counted, frames: FrameArrays) -> None:
        _, outputs = track(counted.step, frames)
        scan = jax.jit(
            lambda state, frames, given: lax.scan(lambda s, f: track_step(s, f, given, PLAN), state, frames),
            compiler_options=QUICK_COMPILE,
        )
        state, scanned = scan(new_state(), frames, params())
        assert described(state) == described(new_state())
        np.testing.assert_allclose(scanned.T_world_cam.wxyz_xyz, poses(outputs), atol=1e-4)

    def test_vmap_equals_loop(self, counted: Counted, frames: FrameArrays) -> None:
        """Two recordings side by side, one of them a frame ahead."""
        batched = jax.jit(
            jax.vmap(lambda s, f, p: track_step(s, f, p, PLAN), in_axes=(0, 0, None)), compiler_options=QUICK_COMPILE
        )
        both = lambda *trees: jax.tree.map(lambda *leaves: jnp.stack(leaves), *trees)
        singles, states = [new_state(), new_state()], both(new_state(), new_state())
        for index in range(5):
            pair = [at(frames, index), at(frames, index + 1)]
            states, outputs = batched(states, both(*pair), params())
            for which in range(2):
                singles[which], output = counted.step(singles[which], pair[which], params())
                np.testing.assert_allclose(outputs.T_world_cam.wxyz_xyz[which], output.T_world_cam.wxyz_xyz, atol=1e-4)
                assert int(outputs.status[which]) == int(output.status)
