"""Track many clips at once in one compiled program: several recordings, or one with several seeds or settings."""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Float, Int

from jaxslam.errors import ConfigError, FrameError
from jaxslam.runtime.compiled import compiled
from jaxslam.runtime.compiler_options import FAST_COMPILE, SINGLE_THREAD
from jaxslam.sensors.frame_arrays import FrameArrays, check_gray_range, check_mask_range
from jaxslam.tracking.initial_state import DEFAULT_PLAN, init_state
from jaxslam.tracking.state import TrackParams, TrackPlan, TrackState
from jaxslam.tracking.step import track_step


class TrackedClips(NamedTuple):
    """Results of clips that were tracked at once, as NumPy arrays.

    Attributes:
        T_world_cam: `(clips, frames, 7)` poses, `wxyz_xyz`; the world of a clip is its first camera frame.
        status: `(clips, frames)` a `TrackStatus` of each frame.
    """

    T_world_cam: Float[np.ndarray, "clips frames 7"]
    status: Int[np.ndarray, "clips frames"]


class _Batch(NamedTuple):
    """Clips with the seed and the settings of each."""

    clips: Sequence[FrameArrays]
    seeds: Sequence[int]
    params: Sequence[TrackParams]


def track_clips(
    clips: Sequence[FrameArrays],
    params: TrackParams | Sequence[TrackParams],
    plan: TrackPlan = DEFAULT_PLAN,
    *,
    seeds: Sequence[int] | None = None,
    at_once: int | None = None,
    threads: int = 1,
) -> TrackedClips:
    """Track clips in parallel with `vmap` of `track_step`; the poses equal those of each clip alone up to rounding.

    On an accelerator, keep the defaults of `at_once` and `threads`. On a CPU, a few clips at once with one thread per
    core are the fastest (`jaxslam bench batch` measures it) and take the least memory: that of `at_once * threads`
    trackers. Each value of `at_once` is compiled once.

    Args:
        clips: Clips from `stack_frames`, NumPy arrays of one shape. To track a clip with several seeds or settings,
            repeat it in the list; that takes no memory.
        params: Camera and thresholds, for all clips or one for each.
        plan: Array sizes and search settings, static.
        seeds: Seeds of the random choices, one for each clip; 0 by default.
        at_once: Number of clips that one program tracks; all by default. The last batch is filled with copies.
        threads: Number of programs that run at the same time. JAX settings of one thread, such as those of `with
            jax.enable_x64()`, do not apply in the other threads.

    Raises:
        FrameError: If there is no clip or no frame, clips differ in shape or type, or gray values are from 0 to 1.
        ConfigError: If the number of `params` or `seeds` differs from the number of clips, or `at_once` or `threads` is
            below 1.
    """
    _check_clips(clips)
    batch = _Batch(
        clips,
        [0] * len(clips) if seeds is None else list(seeds),
        [params] * len(clips) if isinstance(params, TrackParams) else list(params),
    )
    size = len(clips) if at_once is None else at_once
    _check_settings(batch, size, threads)
    size = min(size, len(clips))
    some = partial(_track, batch, size, plan)
    first = range(0, len(clips), size)
    if threads == 1:
        parts = [some(index) for index in first]
    else:
        with ThreadPoolExecutor(threads, thread_name_prefix="jaxslam-clips") as pool:
            parts = list(pool.map(some, first))
    poses, statuses = (np.concatenate(column)[: len(clips)] for column in zip(*parts, strict=True))
    return TrackedClips(poses, statuses)


def _track(batch: _Batch, size: int, plan: TrackPlan, first: int) -> TrackedClips:
    """Track `size` clips from the index `first` on; the last clip is repeated if there are fewer."""
    which = [min(first + index, len(batch.clips) - 1) for index in range(size)]
    clips = [batch.clips[index] for index in which]
    params = _stacked([batch.params[index] for index in which])
    seeds = np.array([batch.seeds[index] for index in which], np.int32)
    num_frames, height, width = clips[0].image.shape
    states = _new_states(seeds, height, width, plan, clips[0].image.dtype, clips[0].depth.dtype)
    found: list[tuple[Array, Array]] = []
    for frame in range(num_frames):
        now = _stacked([_frame_of(clip, frame) for clip in clips])
        states, seen = _step(states, now, params, plan)
        found.append(seen)
        jax.block_until_ready(found[-2:-1])  # prepare only one frame ahead, so that memory is bounded
    poses, statuses = zip(*jax.device_get(found), strict=True)
    return TrackedClips(np.stack(poses, axis=1), np.stack(statuses, axis=1))


@compiled(when="first use", static=("height", "width", "plan", "image_dtype", "dtype"))
def _new_states(
    seeds: Int[Array, " clips"], height: int, width: int, plan: TrackPlan, image_dtype: np.dtype, dtype: np.dtype
) -> TrackState:
    make = partial(init_state, height, width, plan, image_dtype=image_dtype, dtype=dtype)
    return jax.vmap(lambda seed: make(seed=seed))(seeds)


# In a single thread: it is as fast for a batch, and programs in several threads do not wait for each other.
@compiled(when="first use", static="plan", donate="states", options=FAST_COMPILE | SINGLE_THREAD)
def _step(
    states: TrackState, frames: FrameArrays, params: TrackParams, plan: TrackPlan
) -> tuple[TrackState, tuple[Array, Array]]:
    """Track the next frame of each clip; return the states, and the poses and statuses."""
    states, outputs = jax.vmap(partial(track_step, plan=plan))(states, frames, params)
    return states, (outputs.T_world_cam.wxyz_xyz, outputs.status)


def _stacked(trees: Sequence[Any]) -> Any:
    return jax.tree.map(lambda *leaves: np.stack(leaves), *trees)


def _frame_of(clip: FrameArrays, index: int) -> FrameArrays:
    return jax.tree.map(lambda array: array[index], clip)


def _check_clips(clips: Sequence[FrameArrays]) -> None:
    if not clips:
        raise FrameError("clips: expected at least one, got none")
    shape = np.shape(clips[0].image)
    if len(shape) != 3 or not shape[0]:
        raise FrameError(f"clips: expected images (frames, h, w) of at least one frame, got {shape}")
    kinds = [["none" if array is None else f"{array.dtype} {np.shape(array)}" for array in clip] for clip in clips]
    for index, kind in enumerate(kinds):
        for name, one, other in zip(FrameArrays._fields, kinds[0], kind, strict=True):
            if one != other:
                raise FrameError(f"clips: {name}: expected {one} as in the first clip, got {other} in clip {index}")
    for index, clip in enumerate(clips):
        check_gray_range(f"clips: image of clip {index}", clip.image, FrameError)
        check_mask_range(f"clips: ignore of clip {index}", clip.ignore, FrameError)


def _check_settings(batch: _Batch, at_once: int, threads: int) -> None:
    for name, given in (("params", batch.params), ("seeds", batch.seeds)):
        if len(given) != len(batch.clips):
            raise ConfigError(f"{name}: expected one for each of {len(batch.clips)} clips, got {len(given)}")
    for name, value in (("at_once", at_once), ("threads", threads)):
        if value < 1:
            raise ConfigError(f"{name}: expected at least 1, got {value}")
