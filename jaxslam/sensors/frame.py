"""One input frame, and its checks."""

import numbers
from dataclasses import dataclass

import cv2
import numpy as np

from jaxslam.errors import FrameError, brief_repr
from jaxslam.sensors.imu import ImuSamples

_INT64 = np.iinfo(np.int64)


@dataclass(frozen=True, eq=False)
class Frame:
    """A color or gray image with depth, or a rectified stereo pair, taken at one time.

    Only the structure is checked: an image that is black or frozen, or depth that is all NaN, makes a valid frame,
    and the tracker reports how it handles it. Arrays are kept without a copy: do not write to them while jaxslam works
    on the frame.

    Attributes:
        timestamp_ns: Time of exposure, int nanoseconds on any clock that never goes back. Times of arrival will do:
            where they fit no frame rate, the tracker counts frames instead.
        image: `(height, width, 3)` RGB or `(height, width)` gray, uint8.
        depth_m: `(height, width)` float32 depth along the optical axis in meters; 0 or NaN where missing. `None` for
            a stereo pair, and for a frame that the depth sensor has nothing for, as one of half the rate.
        dynamic_mask: `(height, width)` bool, true where objects move or may move; `None` if unknown.
        depth_timestamp_ns: Time of the depth image, int nanoseconds, for a sensor that takes it apart from the color
            image but within a second of it; `None` if both have the same time.
        right: Image of the right camera of a rectified pair, with the shape and type of `image`, the left one; `None`
            for a camera that measures depth. With a right image, `depth_m` is only the start value of stereo matching.
        imu: Samples of an IMU after the frame before, up to this frame's time, on the same clock; `None` without an
            IMU. A `Slam` that has the data sheet of the IMU predicts from them how the camera turns.
        played_backward: Whether the frame is part of a recording that is played backward. A rolling shutter then reads
            the last row first.

    Raises:
        FrameError: If a field has the wrong type or shape, the images differ in size, or a sample of the IMU is later
            than the frame.
    """

    timestamp_ns: int
    image: np.ndarray
    depth_m: np.ndarray | None = None
    dynamic_mask: np.ndarray | None = None
    depth_timestamp_ns: int | None = None
    right: np.ndarray | None = None
    imu: ImuSamples | None = None
    played_backward: bool = False

    def __post_init__(self) -> None:
        object.__setattr__(self, "timestamp_ns", _timestamp("timestamp_ns", self.timestamp_ns))
        if self.depth_timestamp_ns is not None:
            depth_timestamp_ns = _timestamp("depth_timestamp_ns", self.depth_timestamp_ns)
            object.__setattr__(self, "depth_timestamp_ns", depth_timestamp_ns)
        _check_image("image", self.image)
        if self.depth_m is not None:
            _check_plane("depth_m", self.depth_m, np.float32, self.size)
        if self.right is not None:
            _check_image("right", self.right)
            if self.right.shape != self.image.shape:
                raise FrameError(
                    f"right: expected the shape of the left image, {self.image.shape}, got {self.right.shape}"
                )
        if self.dynamic_mask is not None:
            _check_plane("dynamic_mask", self.dynamic_mask, np.bool_, self.size)
        if self.imu is not None:
            _check_imu(self.imu, self.timestamp_ns)

    @property
    def size(self) -> tuple[int, int]:
        """`(width, height)` in pixels."""
        return self.image.shape[1], self.image.shape[0]

    @property
    def depth_delay_ns(self) -> int:
        """Time from the image to the depth image in nanoseconds; 0 if both have the same time."""
        return 0 if self.depth_timestamp_ns is None else self.depth_timestamp_ns - self.timestamp_ns


def check_frame(frame: Frame, width: int, height: int, *, pair: bool = False) -> None:
    """Refuse a frame that does not fit the camera.

    Args:
        frame: The frame to check.
        width: The camera's image width in pixels.
        height: The camera's image height in pixels.
        pair: Whether the camera takes stereo pairs.

    Raises:
        FrameError: If it is not a `Frame`, its size differs from the camera's, or a depth image or a stereo pair is
            given where the other is expected.
    """
    if not isinstance(frame, Frame):
        got = f"{type(frame).__name__}; make one: Frame(timestamp_ns, image, depth_m)"
        raise FrameError(f"frame: expected a jaxslam.Frame, got {got}")
    if frame.size != (width, height):
        raise FrameError(f"image: expected the camera's {_by((width, height))} pixels, got {_by(frame.size)}")
    if pair and frame.right is None:
        raise FrameError("right: expected the right image, as the camera is a stereo pair, got none")
    if not pair and frame.depth_m is None and frame.right is not None:
        raise FrameError(
            "depth_m: expected depth, as the camera is no stereo pair (baseline_m), got a right image alone"
        )


def to_gray(image: np.ndarray, out: np.ndarray | None = None) -> np.ndarray:
    """Convert an RGB image to `(height, width)` uint8 gray (ITU-R BT.601 weights); return a gray image unchanged.

    Args:
        image: `(height, width, 3)` RGB or `(height, width)` gray, uint8.
        out: `(height, width)` uint8 array to write to and return; `None` to allocate one where needed.
    """
    if image.ndim == 3:
        return cv2.cvtColor(image, cv2.COLOR_RGB2GRAY, dst=out)
    if out is None:
        return image
    np.copyto(out, image)
    return out


def _timestamp(field: str, timestamp_ns: object) -> int:
    """Return a time as Python's `int`, whose differences do not overflow as NumPy's do."""
    if isinstance(timestamp_ns, bool) or not isinstance(timestamp_ns, numbers.Integral):
        hint = " seconds? (use round(seconds * 1e9))" if isinstance(timestamp_ns, float) else ""
        raise FrameError(f"{field}: expected an int in nanoseconds, got {brief_repr(timestamp_ns)}{hint}")
    if not _INT64.min <= int(timestamp_ns) <= _INT64.max:
        bits = int(timestamp_ns).bit_length() + 1
        raise FrameError(f"{field}: expected an int that fits 64 bits, got one of {bits} bits")
    return int(timestamp_ns)


def _check_image(field: str, image: object) -> None:
    expected = "expected (height, width, 3) RGB or (height, width) gray, uint8"
    if not isinstance(image, np.ndarray):
        raise FrameError(f"{field}: {expected}, got {type(image).__name__}")
    if image.ndim not in (2, 3) or (image.ndim == 3 and image.shape[2] != 3) or image.size == 0:
        hint = f"; drop the alpha channel: {field}[..., :3]" if image.shape[2:] == (4,) else ""
        raise FrameError(f"{field}: {expected}, got shape {image.shape}{hint}")
    if image.dtype != np.uint8:
        hint = "; scale it to 0 to 255 and use astype(numpy.uint8)" if image.dtype.kind == "f" else ""
        raise FrameError(f"{field}: {expected}, got {image.dtype}{hint}")


def _check_plane(field: str, plane: object, dtype: type[np.generic], size: tuple[int, int]) -> None:
    expected = f"expected (height, width) {np.dtype(dtype).name}"
    if not isinstance(plane, np.ndarray):
        raise FrameError(f"{field}: {expected}, got {type(plane).__name__}")
    if plane.dtype != dtype:
        raise FrameError(f"{field}: {expected}, got {plane.dtype}{_dtype_hint(field, plane.dtype)}")
    if plane.ndim != 2:
        raise FrameError(f"{field}: {expected}, got shape {plane.shape}")
    if plane.shape != size[::-1]:
        raise FrameError(f"{field}: expected the image's {_by(size)} pixels, got {_by(plane.shape[::-1])}")


def _check_imu(imu: object, timestamp_ns: int) -> None:
    if not isinstance(imu, ImuSamples):
        raise FrameError(f"imu: expected a jaxslam.sensors.ImuSamples, got {type(imu).__name__}")
    if len(imu) and imu.timestamps_ns[-1] > timestamp_ns:
        late_ns = int(imu.timestamps_ns[-1]) - timestamp_ns
        raise FrameError(f"imu: expected samples up to the frame's time, got one {late_ns} ns later")


def _dtype_hint(field: str, dtype: np.dtype) -> str:
    if field != "depth_m":
        return "; use mask > 0"
    if dtype.kind in "iu":
        return "; divide the counts by the camera's depth_scale_per_m: (counts / scale).astype(numpy.float32)"
    return "; use astype(numpy.float32)"


def _by(size: tuple[int, ...]) -> str:
    return f"{size[0]}x{size[1]}"
