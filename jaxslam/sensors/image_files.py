"""Reading of a recording's image files, with errors that name the file."""

from pathlib import Path

import cv2
import numpy as np

from jaxslam.errors import DatasetError
from jaxslam.sensors.camera import Camera

_JPEG_START, _JPEG_END = b"\xff\xd8", b"\xff\xd9"
_AS_STORED = cv2.IMREAD_IGNORE_ORIENTATION  # calibrations refer to the pixels before any EXIF rotation


def read_color(path: Path) -> np.ndarray:
    """Read a `(height, width, 3)` uint8 RGB image; a gray file gives three equal channels.

    Raises:
        DatasetError: If the file is missing, truncated or not an image.
    """
    return cv2.cvtColor(_decode(path, cv2.IMREAD_COLOR | _AS_STORED), cv2.COLOR_BGR2RGB)


def read_gray(path: Path) -> np.ndarray:
    """Read a `(height, width)` uint8 gray image; a color file is converted to gray.

    Raises:
        DatasetError: If the file is missing, truncated or not an image.
    """
    return _decode(path, cv2.IMREAD_GRAYSCALE | _AS_STORED)


def read_depth(path: Path, scale_per_m: float) -> np.ndarray:
    """Read `(height, width)` float32 depth in meters from a uint16 file; 0 where missing.

    Args:
        path: The image file.
        scale_per_m: Counts per meter.

    Raises:
        DatasetError: If the file is missing, truncated or not an image, or its pixels are not single uint16 values.
    """
    counts = _decode(path, cv2.IMREAD_UNCHANGED)
    if counts.dtype != np.uint16 or counts.ndim != 2:
        channels = 1 if counts.ndim == 2 else counts.shape[2]
        raise DatasetError(f"{path}: expected depth as one uint16 a pixel, got {channels} x {counts.dtype}")
    return counts.astype(np.float32) / np.float32(scale_per_m)


def read_depth_meters(path: Path) -> np.ndarray:
    """Read `(height, width)` float32 depth in meters from a NumPy file; 0 where it is not finite or not positive.

    Raises:
        DatasetError: If the file is missing or damaged, or does not hold a two-dimensional array of floats.
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
    """Refuse an image whose size is not the camera's.

    Raises:
        DatasetError: If the sizes differ.
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
    # libjpeg fills the missing part of a truncated file with gray instead of failing
    is_cut = content.startswith(_JPEG_START) and _JPEG_END not in content[-64:]
    image = None if is_cut or not content else cv2.imdecode(np.frombuffer(content, np.uint8), flags)
    if image is None:
        raise DatasetError(f"{path}: expected an image, got {len(content)} bytes that cannot be decoded")
    return image
