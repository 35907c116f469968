"""The arrays of a frame that the compiled step takes: one frame, or a clip with time as the first axis."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Array, Bool, Float, Num, UInt8
from numpy.typing import ArrayLike, DTypeLike

from jaxslam.errors import FrameError
from jaxslam.runtime.aligned_memory import aligned_array
from jaxslam.sensors.frame import Frame, to_gray


class FrameArrays(NamedTuple):
    """The arrays of one frame, as the compiled step takes them; NumPy arrays will do.

    Attributes:
        image: `(h, w)` gray values, 0 to 255: `uint8`, or floating point to differentiate with respect to them.
        depth: `(h, w)` floating-point depth in meters; 0 or not finite where missing.
        ignore: `(h, w)` mask of the pixels that are not to be trusted (people, the robot itself): `bool`, or floating
            point from 0 (trusted) to 1 (ignored) to differentiate with respect to it. A point has one minus that of its
            pixel of its weight in the pose; corners are detected where it is at most one half.
        dt_s: Time since the previous frame in seconds.
        depth_delay_s: Time from the image to the depth image in seconds.
        right: `(h, w)` right image of a rectified pair, of the type of `image`; `None` where depth is measured. With a
            right image, `depth` is only the start value of stereo matching.
        movable: `(h, w)` number of the movable object at each pixel, from 1, plus 128 for an object that does not move
            by itself; 0 where there is none. Needed by a plan with `motion`, which finds out which objects do move;
            `None` without.
        readout_sign: 1, or -1 where a rolling shutter reads the last row first, as in a recording that is played
            backward; `None` for 1.
    """

    image: Num[Array, "*time h w"]
    depth: Float[Array, "*time h w"]
    ignore: Bool[Array, "*time h w"] | Float[Array, "*time h w"]
    dt_s: Float[Array, "*time"]
    depth_delay_s: Float[Array, "*time"]
    right: Num[Array, "*time h w"] | None = None
    movable: UInt8[Array, "*time h w"] | None = None
    readout_sign: Float[Array, "*time"] | None = None


def frame_arrays(frame: Frame, dt_s: float, dtype: DTypeLike = np.float32) -> FrameArrays:
    """Return the arrays of a frame for `track_step`, in NumPy; arrays of the right type are not copied.

    Args:
        frame: The frame; color is converted to gray. A stereo pair needs rough depth: see
            `jaxslam.sensors.stereo_depth.RoughDepth`.
        dt_s: Time since the previous frame in seconds; any number for the first frame.
        dtype: Floating-point type of all arrays but the image, equal to that of state and parameters. The default is
            float32, with `jax_enable_x64` too.
    """
    ignore = np.zeros(frame.size[::-1], bool) if frame.dynamic_mask is None else frame.dynamic_mask
    depth = _depth(frame).astype(dtype, copy=False)
    right = None if frame.right is None else to_gray(frame.right)
    times, sign = _times(frame, dt_s, dtype), _readout_sign(frame, dtype)
    arrays: Any = (to_gray(frame.image), depth, ignore, *times, right, None, sign)
    return FrameArrays(*arrays)


def check_gray_range(name: str, image: ArrayLike, error: type[Exception] = ValueError) -> None:
    """Refuse a floating-point image whose gray values are from 0 to 1 where 0 to 255 is expected.

    A black image passes: it is a valid frame without any points.

    Args:
        name: Name of the image in the message.
        image: Image of any shape, not a tracer.
        error: Class of the error to raise.
    """
    values = np.asarray(image)
    if np.issubdtype(values.dtype, np.integer) or not values.size:
        return
    least, most = float(values.min()), float(values.max())
    if least >= 0 and 0 < most <= 1:
        raise error(f"{name}: expected gray values from 0 to 255, got {least:.3g} to {most:.3g}; multiply them by 255")


def check_mask_range(name: str, ignore: ArrayLike, error: type[Exception] = ValueError) -> None:
    """Refuse a floating-point mask whose values are not all from 0 to 1.

    Args:
        name: Name of the mask in the message.
        ignore: Mask of any shape and type, not a tracer.
        error: Class of the error to raise.
    """
    values = np.asarray(ignore)
    if values.dtype == np.bool_ or not values.size:
        return
    least, most = float(values.min()), float(values.max())
    if not (least >= 0 and most <= 1):  # NaN is refused too
        raise error(f"{name}: expected values from 0 (trusted) to 1 (ignored), got {least:.3g} to {most:.3g}")


def own_copy(arrays: FrameArrays) -> FrameArrays:
    """Copy the arrays of a frame, for use after their buffers are used again."""
    copies: list[Any] = [None if array is None else np.array(array) for array in arrays]
    return FrameArrays(*copies)


class _Buffers(NamedTuple):
    """Memory of the arrays of one frame."""

    image: np.ndarray
    depth: np.ndarray
    ignore: np.ndarray
    right: np.ndarray | None
    movable: np.ndarray | None
    matched: np.ndarray | None


class FrameMemory:
    """Reusable buffers for the arrays of the current frame, and of the last one that was kept.

    XLA computes on them without a copy: see `aligned_array`.
    """

    def __init__(self, height: int, width: int, *, pairs: bool = False, movable: bool = False) -> None:
        """Allocate buffers for frames of one size.

        Args:
            height: Image height in pixels.
            width: Image width in pixels.
            pairs: Whether to hold right images.
            movable: Whether to hold the numbers of movable objects.
        """
        size = (height, width)
        self._now, self._kept = (
            _Buffers(
                aligned_array(size, np.uint8),
                aligned_array(size, np.float32),
                aligned_array(size, np.bool_),
                aligned_array(size, np.uint8) if pairs else None,
                aligned_array(size, np.uint8) if movable else None,
                aligned_array(size, np.float32) if pairs else None,
            )
            for _ in range(2)
        )
        self._nothing = aligned_array(size, np.bool_)
        self._nothing[:] = False

    def hold(self, frame: Frame, dt_s: float, *, depth_follows: bool = False) -> FrameArrays:
        """Return the arrays of a frame as `frame_arrays` does.

        They are valid until the next call, or after `keep` until the next call after the next `keep`.

        Args:
            frame: The frame.
            dt_s: Time since the previous frame in seconds.
            depth_follows: Whether the frame has no depth yet; that of the arrays must be replaced before it is read.
        """
        now = self._now
        to_gray(frame.image, out=now.image)
        if not depth_follows:
            np.copyto(now.depth, _depth(frame))
        right = None if now.right is None or frame.right is None else to_gray(frame.right, out=now.right)
        ignore = self._nothing
        if frame.dynamic_mask is not None:
            ignore = now.ignore
            np.copyto(ignore, frame.dynamic_mask)
        if now.movable is not None:
            now.movable[:] = 0
        times, sign = _times(frame, dt_s, np.float32), _readout_sign(frame, np.float32)
        arrays: Any = (now.image, now.depth, ignore, *times, right, now.movable, sign)
        return FrameArrays(*arrays)

    def keep(self) -> None:
        """Keep the arrays of the current frame valid until another frame is kept."""
        self._now, self._kept = self._kept, self._now

    @property
    def matched_depth(self) -> np.ndarray | None:
        """`(h, w)` buffer for the depth of the current pair, which no array of `hold` shares; `None` without pairs."""
        return self._now.matched

    def with_movable(self, arrays: FrameArrays, labels: np.ndarray) -> FrameArrays:
        """Return the current arrays with the numbers `(h, w)` of movable objects."""
        movable: Any = self._now.movable
        assert movable is not None
        np.copyto(movable, labels)
        return arrays._replace(movable=movable)

    def ignoring(self, arrays: FrameArrays, mask: np.ndarray) -> FrameArrays:
        """Return the current arrays with pixels ignored where `mask` `(h, w)` is true."""
        if mask is arrays.ignore:
            return arrays
        ignore: Any = self._now.ignore
        np.copyto(ignore, mask)
        return arrays._replace(ignore=ignore)


def stack_frames(frames: Sequence[Frame], previous_ns: int | None = None, dtype: DTypeLike = np.float32) -> FrameArrays:
    """Return a clip for `lax.scan` over `track_step`: the arrays of all frames, with time as their first axis.

    Args:
        frames: The frames, at least one, all of one size.
        previous_ns: Time of the frame before the first one, in nanoseconds. If `None`, the step before the first frame
            is taken to be as long as the step after it.
        dtype: Floating-point type, as for `frame_arrays`.

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
    """Return the depth image of a frame, all 0 if it has none and is no stereo pair."""
    if frame.depth_m is not None:
        return frame.depth_m
    if frame.right is None:
        return np.zeros(frame.size[::-1], np.float32)
    raise FrameError(
        "depth_m: expected depth for matching to begin with, got none; see jaxslam.sensors.stereo_depth.RoughDepth"
    )


def _times(frame: Frame, dt_s: float, dtype: DTypeLike) -> tuple[np.ndarray, np.ndarray]:
    return np.asarray(dt_s, dtype), np.asarray(frame.depth_delay_ns * 1e-9, dtype)


def _readout_sign(frame: Frame, dtype: DTypeLike) -> np.ndarray:
    return np.asarray(-1 if frame.played_backward else 1, dtype)
