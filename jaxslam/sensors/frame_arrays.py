"""Frames as the compiled step takes them: one, or a clip of them with time as the first axis."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Array, Bool, Float, Num, UInt8
from numpy.typing import ArrayLike, DTypeLike

from jaxslam.errors import FrameError
from jaxslam.runtime.aligned_memory import aligned_array
from jaxslam.sensors.frame import Frame, to_gray


class FrameArrays(NamedTuple):
    """One frame as the compiled step takes it; NumPy arrays will do.

    Attributes:
        image: `(h, w)` gray, 0 to 255; `uint8`, or floating point to differentiate with respect to it.
        depth: `(h, w)` meters, floating point; 0 or not finite where missing.
        ignore: `(h, w)` true where nothing is to be trusted (people, the robot itself).
        dt_s: Seconds since the frame before.
        depth_delay_s: Seconds from the time of the image to the time of the depth.
        right: `(h, w)` the right image of a rectified pair, as `image`; `None` where depth is measured. With it `depth`
            is where matching begins.
        movable: `(h, w)` number of the thing that may move at each pixel, from 1, 0 for none; for a plan with `motion`,
            which finds out whether it does. `None` without.
    """

    image: Num[Array, "*time h w"]
    depth: Float[Array, "*time h w"]
    ignore: Bool[Array, "*time h w"]
    dt_s: Float[Array, "*time"]
    depth_delay_s: Float[Array, "*time"]
    right: Num[Array, "*time h w"] | None = None
    movable: UInt8[Array, "*time h w"] | None = None


def frame_arrays(frame: Frame, dt_s: float, dtype: DTypeLike = np.float32) -> FrameArrays:
    """A frame for `track_step`, as NumPy arrays; nothing that has the right type is copied.

    Args:
        frame: The frame; color becomes gray. A stereo pair needs rough depth, see `stereo.RoughDepth`.
        dt_s: Seconds since the frame before; for the first one any number.
        dtype: Floating-point type of everything but the image, that of state and parameters; float32 if not given,
            also with `jax_enable_x64`.
    """
    ignore = np.zeros(frame.size[::-1], bool) if frame.dynamic_mask is None else frame.dynamic_mask
    depth = _depth(frame).astype(dtype, copy=False)
    right = None if frame.right is None else to_gray(frame.right)
    arrays: Any = (to_gray(frame.image), depth, ignore, *_times(frame, dt_s, dtype), right)
    return FrameArrays(*arrays)


def check_gray_range(name: str, image: ArrayLike, error: type[Exception] = ValueError) -> None:
    """Refuse an image in floating point whose gray values are from 0 to 1 where 0 to 255 is expected.

    A black one passes: it is a frame in which nothing is seen.

    Args:
        name: What to call it in the message.
        image: Of any shape, no tracer.
        error: The class of error to raise.
    """
    values = np.asarray(image)
    if np.issubdtype(values.dtype, np.integer) or not values.size:
        return
    least, most = float(values.min()), float(values.max())
    if least >= 0 and 0 < most <= 1:
        raise error(f"{name}: expected gray values from 0 to 255, got {least:.3g} to {most:.3g}; multiply them by 255")


class FrameMemory:
    """Room for the arrays of one frame, filled anew with each.

    XLA computes on it in place: see `aligned_array`.
    """

    def __init__(self, height: int, width: int, *, pairs: bool = False, movable: bool = False) -> None:
        """Make room for frames of one size, or for pairs; with what may move in them, or without."""
        self._movable = aligned_array((height, width), np.uint8) if movable else None
        self._right = aligned_array((height, width), np.uint8) if pairs else None
        self._image, self._depth = aligned_array((height, width), np.uint8), aligned_array((height, width), np.float32)
        self._ignore, self._nothing = (aligned_array((height, width), np.bool_) for _ in range(2))
        self._nothing[:] = False

    def hold(self, frame: Frame, dt_s: float, *, depth_follows: bool = False) -> FrameArrays:
        """The arrays of a frame, as of `frame_arrays`, until the next one is held.

        Args:
            frame: The frame.
            dt_s: Seconds since the frame before.
            depth_follows: Whether its depth is given to `hold_depth`, before anything looks at it.
        """
        to_gray(frame.image, out=self._image)
        if not depth_follows:
            np.copyto(self._depth, _depth(frame))
        right = None if self._right is None or frame.right is None else to_gray(frame.right, out=self._right)
        ignore = self._nothing
        if frame.dynamic_mask is not None:
            ignore = self._ignore
            np.copyto(ignore, frame.dynamic_mask)
        if self._movable is not None:
            self._movable[:] = 0
        arrays: Any = (self._image, self._depth, ignore, *_times(frame, dt_s, np.float32), right, self._movable)
        return FrameArrays(*arrays)

    def hold_depth(self, depth_m: np.ndarray) -> None:
        """Depth `(h, w)` of the frame held, meters."""
        np.copyto(self._depth, depth_m)

    def with_movable(self, arrays: FrameArrays, labels: np.ndarray) -> FrameArrays:
        """The arrays held, with the numbers `(h, w)` of things that may move."""
        assert self._movable is not None
        np.copyto(self._movable, labels)
        movable: Any = self._movable
        return arrays._replace(movable=movable)

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
        FrameError: If there is no frame, their sizes differ, or only some are stereo pairs.
    """
    if not frames:
        raise FrameError("frames: expected at least one, got none")
    sizes = {frame.size for frame in frames}
    if len(sizes) > 1:
        raise FrameError(f"frames: expected one size, got {sorted(sizes)} (width, height)")
    if len({frame.right is None for frame in frames}) > 1:
        raise FrameError("frames: expected stereo pairs or frames with depth, got both")
    times_ns = np.array([frame.timestamp_ns for frame in frames], np.int64)
    before = 2 * times_ns[0] - times_ns[min(1, len(times_ns) - 1)] if previous_ns is None else np.int64(previous_ns)
    steps_s = np.diff(times_ns, prepend=before) * 1e-9
    arrays = [frame_arrays(frame, step_s, dtype) for frame, step_s in zip(frames, steps_s, strict=True)]
    stacked: Any = (None if column[0] is None else np.stack(column) for column in zip(*arrays, strict=True))
    return FrameArrays(*stacked)


def _depth(frame: Frame) -> np.ndarray:
    if frame.depth_m is None:
        raise FrameError(
            "depth_m: expected depth for matching to begin with, got none; see jaxslam.sensors.stereo_depth.RoughDepth"
        )
    return frame.depth_m


def _times(frame: Frame, dt_s: float, dtype: DTypeLike) -> tuple[np.ndarray, np.ndarray]:
    delay_ns = 0 if frame.depth_timestamp_ns is None else frame.depth_timestamp_ns - frame.timestamp_ns
    return np.asarray(dt_s, dtype), np.asarray(delay_ns * 1e-9, dtype)
