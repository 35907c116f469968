"""Frames as the compiled step takes them: one, or a clip of them with time as the first axis."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Array, Bool, Float, Num
from numpy.typing import DTypeLike

from jaxslam.aligned import aligned_array
from jaxslam.errors import FrameError
from jaxslam.frame import Frame, to_grey


class FrameArrays(NamedTuple):
    """One frame as the compiled step takes it; NumPy arrays will do.

    Attributes:
        image: `(h, w)` grey, 0 to 255; `uint8`, or floating point to differentiate with respect to it.
        depth: `(h, w)` metres, floating point; 0 or not finite where missing.
        ignore: `(h, w)` true where nothing is to be trusted (people, the robot itself).
        dt_s: Seconds since the frame before.
        depth_delay_s: Seconds from the time of the image to the time of the depth.
    """

    image: Num[Array, "*time h w"]
    depth: Float[Array, "*time h w"]
    ignore: Bool[Array, "*time h w"]
    dt_s: Float[Array, "*time"]
    depth_delay_s: Float[Array, "*time"]


def frame_arrays(frame: Frame, dt_s: float, dtype: DTypeLike = np.float32) -> FrameArrays:
    """A frame for `track_step`, as NumPy arrays; nothing that has the right type is copied.

    Args:
        frame: The frame; colour becomes grey.
        dt_s: Seconds since the frame before; for the first one any number.
        dtype: Floating-point type of everything but the image, that of the state.
    """
    ignore = np.zeros(frame.depth_m.shape, bool) if frame.dynamic_mask is None else frame.dynamic_mask
    depth = frame.depth_m.astype(dtype, copy=False)
    arrays: Any = (to_grey(frame.image), depth, ignore, *_times(frame, dt_s, dtype))
    return FrameArrays(*arrays)


class FrameMemory:
    """Room for the arrays of one frame, filled anew with each.

    XLA computes on it in place: see `aligned_array`.
    """

    def __init__(self, height: int, width: int) -> None:
        """Make room for frames of one size."""
        self._image, self._depth = aligned_array((height, width), np.uint8), aligned_array((height, width), np.float32)
        self._ignore, self._nothing = (aligned_array((height, width), np.bool_) for _ in range(2))
        self._nothing[:] = False

    def hold(self, frame: Frame, dt_s: float) -> FrameArrays:
        """The arrays of a frame, as of `frame_arrays`, until the next one is held."""
        to_grey(frame.image, out=self._image)
        np.copyto(self._depth, frame.depth_m)
        ignore = self._nothing
        if frame.dynamic_mask is not None:
            ignore = self._ignore
            np.copyto(ignore, frame.dynamic_mask)
        arrays: Any = (self._image, self._depth, ignore, *_times(frame, dt_s, np.float32))
        return FrameArrays(*arrays)

    def ignoring(self, arrays: FrameArrays, mask: np.ndarray) -> FrameArrays:
        """The arrays held, with nothing trusted where `mask` `(h, w)` is true."""
        np.copyto(self._ignore, mask)
        ignore: Any = self._ignore
        return arrays._replace(ignore=ignore)


def stack_frames(frames: Sequence[Frame], previous_ns: int | None = None, dtype: DTypeLike = np.float32) -> FrameArrays:
    """A clip for `lax.scan` over `track_step`: the arrays of all frames, with time as their first axis.

    Args:
        frames: At least one frame, all of one size.
        previous_ns: Time of the frame before the first of them; where there is none, it counts as if it had come as
            long before as the second comes after.
        dtype: As for `frame_arrays`.

    Raises:
        FrameError: If there is no frame, or their sizes differ.
    """
    if not frames:
        raise FrameError("frames: expected at least one, got none")
    sizes = {frame.size for frame in frames}
    if len(sizes) > 1:
        raise FrameError(f"frames: expected one size, got {sorted(sizes)} (width, height)")
    times_ns = np.array([frame.timestamp_ns for frame in frames], np.int64)
    before = 2 * times_ns[0] - times_ns[min(1, len(times_ns) - 1)] if previous_ns is None else np.int64(previous_ns)
    steps_s = np.diff(times_ns, prepend=before) * 1e-9
    arrays = [frame_arrays(frame, step_s, dtype) for frame, step_s in zip(frames, steps_s, strict=True)]
    stacked: Any = (np.stack(column) for column in zip(*arrays, strict=True))
    return FrameArrays(*stacked)


def _times(frame: Frame, dt_s: float, dtype: DTypeLike) -> tuple[np.ndarray, np.ndarray]:
    delay_ns = 0 if frame.depth_timestamp_ns is None else frame.depth_timestamp_ns - frame.timestamp_ns
    return np.asarray(dt_s, dtype), np.asarray(delay_ns * 1e-9, dtype)
