"""Decoding the images of a recording, with errors that name the file."""

from pathlib import Path

import cv2
import numpy as np

from jaxslam.errors import DatasetError
from jaxslam.sensors.camera import Camera

_JPEG_START, _JPEG_END = b"\xff\xd8", b"\xff\xd9"
_AS_STORED = cv2.IMREAD_IGNORE_ORIENTATION  # a calibration speaks of the pixels before any EXIF rotation


def read_color(path: Path) -> np.ndarray:
    """`(height, width, 3)` uint8 RGB; a gray file gives three equal channels.

    Raises:
        DatasetError: If the file is missing, cut short or no image.
    """
    return cv2.cvtColor(_decode(path, cv2.IMREAD_COLOR | _AS_STORED), cv2.COLOR_BGR2RGB)


def read_gray(path: Path) -> np.ndarray:
    """`(height, width)` uint8; a color file becomes gray.

    Raises:
        DatasetError: If the file is missing, cut short or no image.
    """
    return _decode(path, cv2.IMREAD_GRAYSCALE | _AS_STORED)


def read_depth(path: Path, scale_per_m: float) -> np.ndarray:
    """`(height, width)` float32 meters from a uint16 file with `scale_per_m` counts a meter; 0 where missing.

    Raises:
        DatasetError: If the file is missing, cut short, no image, or its pixels are not one uint16 each.
    """
    counts = _decode(path, cv2.IMREAD_UNCHANGED)
    if counts.dtype != np.uint16 or counts.ndim != 2:
        channels = 1 if counts.ndim == 2 else counts.shape[2]
        raise DatasetError(f"{path}: expected depth as one uint16 a pixel, got {channels} x {counts.dtype}")
    return counts.astype(np.float32) / np.float32(scale_per_m)


def read_depth_meters(path: Path) -> np.ndarray:
    """`(height, width)` float32 meters from a NumPy file of floats; 0 where it is not finite or not positive.

    Raises:
        DatasetError: If the file is missing or damaged, or holds no plane of floats.
    """
    try:
        depth_m = np.load(path, allow_pickle=False)
    except (OSError, ValueError, EOFError) as problem:
        raise DatasetError(f"{path}: cannot be read: {problem}") from None
    if not isinstance(depth_m, np.ndarray) or depth_m.ndim != 2 or depth_m.dtype.kind != "f":
        got = f"{depth_m.dtype} {depth_m.shape}" if isinstance(depth_m, np.ndarray) else type(depth_m).__name__
        raise DatasetError(f"{path}: expected (height, width) floats, meters, got {got}")
    return np.where(np.isfinite(depth_m) & (depth_m > 0), depth_m, 0).astype(np.float32)


def check_size(path: Path, image: np.ndarray, camera: Camera) -> None:
    """Refuse an image that is not of the camera's size.

    Raises:
        DatasetError: If it is not.
    """
    height, width = image.shape[:2]
    if (height, width) != (camera.height, camera.width):
        raise DatasetError(
            f"{path}: expected {camera.width}x{camera.height} pixels, the size of camera '{camera.name}',"
            f" got {width}x{height}"
        )


def _decode(path: Path, flags: int) -> np.ndarray:
    try:
        content = path.read_bytes()
    except OSError as problem:
        raise DatasetError(f"{path}: cannot be read: {problem.strerror}") from None
    # libjpeg fills the missing part of a cut file with gray instead of failing
    is_cut = content.startswith(_JPEG_START) and _JPEG_END not in content[-64:]
    image = None if is_cut or not content else cv2.imdecode(np.frombuffer(content, np.uint8), flags)
    if image is None:
        raise DatasetError(f"{path}: expected an image, got {len(content)} bytes that cannot be decoded")
    return image
