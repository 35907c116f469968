"""A clip in one program: the same as its steps, with gradients alone and in batches, in bounded memory."""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array
from quick_compile import quick_compile
from small_scene import PLAN, at, clip, new_state, params, stacked

from jaxslam import FrameArrays, TrackParams, TrackState, rollout, track_step

FRAMES = 6


@pytest.fixture(scope="module")
def frames() -> FrameArrays:
    return stacked(clip().frames[:FRAMES])


def way_m(state: TrackState, frames: FrameArrays, given: TrackParams) -> Array:
    """Squared meters the camera moved from frame to frame, summed up."""
    _, outputs = rollout(state, frames, given, PLAN)
    return jnp.sum(jnp.square(jnp.diff(outputs.T_world_cam.translation(), axis=0)))


gradient: Callable[..., TrackParams] = jax.grad(way_m, argnums=2)


@pytest.fixture(scope="module")
def alone(frames: FrameArrays) -> Any:
    return quick_compile(gradient).lower(new_state(), frames, params()).compile()


def with_focal(scale: float) -> TrackParams:
    given = params()
    camera = given.sensor.intrinsics
    longer = camera._replace(fx=camera.fx * np.float32(scale), fy=camera.fy * np.float32(scale))
    return given._replace(sensor=given.sensor._replace(intrinsics=longer))


@pytest.mark.slow
def test_equals_its_steps(frames: FrameArrays) -> None:
    end, outputs = quick_compile(partial(rollout, plan=PLAN))(new_state(), frames, params())
    step, state = quick_compile(partial(track_step, plan=PLAN)), new_state()
    for index in range(FRAMES):
        state, output = step(state, at(frames, index), params())
        np.testing.assert_allclose(outputs.T_world_cam.wxyz_xyz[index], output.T_world_cam.wxyz_xyz, atol=1e-5)
        assert outputs.status[index] == output.status
    np.testing.assert_array_equal(end.pyramid.levels[0], state.pyramid.levels[0])
    np.testing.assert_array_equal(end.points.valid, state.points.valid)


@pytest.mark.slow
def test_gradients_of_a_batch_are_those_of_each(alone: Any, frames: FrameArrays) -> None:
    """Over cameras and initial states, one of which has another seed."""
    cameras, states = [with_focal(scale) for scale in (1.0, 1.03)], [new_state(seed=seed) for seed in (0, 7)]
    stack = lambda trees: jax.tree.map(lambda *leaves: jnp.stack(leaves), *trees)
    batch = quick_compile(jax.vmap(gradient, in_axes=(0, None, 0)))(stack(states), frames, stack(cameras))
    found = batch.sensor.intrinsics.fx
    each = [alone(state, frames, camera).sensor.intrinsics.fx for state, camera in zip(states, cameras, strict=True)]
    assert found[0] != found[1]
    np.testing.assert_allclose(found, jnp.stack(each), rtol=1e-3)


@pytest.mark.slow
def test_memory_of_a_frame_is_a_state(alone: Any) -> None:
    """Values inside the steps are not kept; they would be some fifteen states a frame."""
    more = stacked(clip().frames[: 2 * FRAMES])
    longer: Any = quick_compile(gradient).lower(new_state(), more, params()).compile()
    of_six, of_twelve = (program.memory_analysis().temp_size_in_bytes for program in (alone, longer))
    of_a_frame = (of_twelve - of_six) / FRAMES
    of_a_state = sum(leaf.nbytes for leaf in jax.tree.leaves(new_state()))
    print(f"a frame {of_a_frame / 1e3:.0f} kB, a state {of_a_state / 1e3:.0f} kB")
    assert of_a_frame < 2 * of_a_state


def test_gray_values_from_0_to_1() -> None:
    dark = stacked(clip().frames[:2], image_dtype=np.float32)
    with pytest.raises(ValueError, match=r"clip\.image: expected gray values from 0 to 255"):
        rollout(new_state(), dark._replace(image=dark.image / 255), params(), PLAN)


def test_an_image_is_no_clip(frames: FrameArrays) -> None:
    with pytest.raises(ValueError, match=r"clip\.image: expected gray images .*, got \(120, 160\)"):
        rollout(new_state(), at(frames, 0), params(), PLAN)
