"""A calibrated camera: its immutable record, its checks and its files."""

import dataclasses
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, ClassVar, Literal

import numpy as np
from jax.typing import DTypeLike
from jaxslam_kernels.camera import Intrinsics, make_intrinsics

from jaxslam.config.loading import configs_dir
from jaxslam.config.validation import Range, ValidatedConfig, from_mapping
from jaxslam.errors import CameraError, JaxSlamError, nearest
from jaxslam.io.atomic_files import write_atomically
from jaxslam.sensors.camera_formats import read_camera_fields

MAX_BASELINE_M = 10.0
"""Longest baseline of a stereo pair in meters; a larger number is probably in millimeters."""

_UNITS = {
    "width": "pixels",
    "height": "pixels",
    "fx": "pixels",
    "fy": "pixels",
    "cx": "pixels, from the center of the top-left pixel",
    "cy": "pixels",
    "distortion": "k1 k2 p1 p2 k3, as in OpenCV",
    "depth_scale_per_m": "counts of the depth image per meter",
    "fps": "frames per second",
    "baseline_m": "meters between left and right camera",
    "far_depth_m": "meters; depth beyond it is not trusted on its own",
    "readout_s": "seconds from the first row to the last; 0 for a global shutter",
    "color_order": "of live images only; image files carry their own order",
    "depth_offset_m": "meters by which every measured depth is too long",
    "depth_delay_s": "seconds from a color image to its depth image, beyond what their timestamps say",
}


@dataclass(frozen=True)
class Camera(ValidatedConfig):
    """A pinhole camera with OpenCV's radial-tangential distortion.

    Attributes:
        name: Name of the camera in messages.
        width: Image width in pixels.
        height: Image height in pixels.
        fx: Horizontal focal length in pixels.
        fy: Vertical focal length in pixels.
        cx: Horizontal coordinate of the principal point in pixels, from the center of the top-left pixel.
        cy: Vertical coordinate of the principal point in pixels, from the center of the top-left pixel.
        distortion: Coefficients `(k1, k2, p1, p2, k3)` as in OpenCV; zeros for rectified images.
        depth_scale_per_m: Counts of the integer depth image per meter: 5000.0 for TUM and Bonn, 1000.0 for
            millimeters; `None` for a camera whose depth comes in meters or from stereo.
        fps: Nominal frames per second. Motion models use timestamps; they use this rate only at the start, and where
            the timestamps fit no rate.
        baseline_m: Distance between left and right camera in meters, at most 10; `None` if not stereo.
        far_depth_m: Depth in meters beyond which a measured depth is not trusted on its own (in ORB-SLAM,
            `ThDepth` times the baseline); `None` if unknown.
        readout_s: Time in seconds a rolling shutter takes from the first row of a color image to the last; 0 for a
            global shutter. `jaxslam.Slam` corrects for it.
        color_order: Channel order of the color images that the camera's driver delivers.
        depth_offset_m: Length in meters by which every measured depth is too long; negative if it is too short.
            `jaxslam.Slam` subtracts it. 0 for a stereo pair.
        depth_delay_s: Time in seconds from a color image to its depth image beyond what their timestamps say; negative
            if depth is earlier. `jaxslam.Slam` adds it. 0 for a stereo pair.

    Raises:
        CameraError: If a value has the wrong type or is impossible.
    """

    name: str
    width: Annotated[int, Range(at_least=8, at_most=32768)]
    height: Annotated[int, Range(at_least=8, at_most=32768)]
    fx: Annotated[float, Range(above=0)]
    fy: Annotated[float, Range(above=0)]
    cx: float
    cy: float
    distortion: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)
    depth_scale_per_m: Annotated[float, Range(above=0)] | None = None
    fps: Annotated[float, Range(above=0, at_most=100_000)] = 30.0
    baseline_m: Annotated[float, Range(above=0)] | None = None
    far_depth_m: Annotated[float, Range(above=0)] | None = None
    readout_s: Annotated[float, Range(at_least=0, at_most=0.1)] = 0.0
    color_order: Literal["rgb", "bgr"] = "rgb"
    depth_offset_m: Annotated[float, Range(at_least=-1, at_most=1)] = 0.0
    depth_delay_s: Annotated[float, Range(at_least=-0.5, at_most=0.5)] = 0.0

    _error: ClassVar[type[JaxSlamError]] = CameraError

    def __post_init__(self) -> None:
        super().__post_init__()
        check_axis("Camera", "x", self.fx, self.cx, self.width)
        check_axis("Camera", "y", self.fy, self.cy, self.height)
        if self.baseline_m is not None:
            check_baseline("Camera.baseline_m", self.baseline_m)

    @classmethod
    def load(cls, source: str | Path) -> "Camera":
        """Read a camera by its known name or from a file of jaxslam, ORB-SLAM2 or ORB-SLAM3.

        Args:
            source: A name such as `tum_fr1` (`known_cameras()` lists them) or the path of a YAML file.

        Raises:
            CameraError: If there is no such name or file, or the file is incomplete, misspelt or impossible.
        """
        path = Path(source)
        if str(source) in known_cameras():
            path = _cameras_dir() / f"{source}.yaml"
        elif not path.is_file():
            hint = nearest(str(source), known_cameras())
            raise CameraError(f"camera: expected a known name or a YAML file, got '{source}'{hint}")
        return from_mapping(cls, read_camera_fields(path), str(path))

    def save(self, path: str | Path) -> None:
        """Write jaxslam's own camera file, which `load` reads back to an equal camera.

        Raises:
            CameraError: If the file cannot be written.
        """
        lines = [_line(key, value) for key, value in dataclasses.asdict(self).items() if value is not None]
        write_atomically(path, ("\n".join(lines) + "\n").encode(), CameraError)

    @property
    def is_stereo(self) -> bool:
        """Whether the camera takes rectified stereo pairs.

        That is so if it has a baseline and no depth images. ORB-SLAM's RGB-D files have both.
        """
        return self.baseline_m is not None and self.depth_scale_per_m is None

    def intrinsics(self, dtype: DTypeLike = np.float32) -> Intrinsics:
        """Return the calibration that the kernels compute with, as arrays of `dtype`."""
        return make_intrinsics(self.fx, self.fy, self.cx, self.cy, self.distortion, dtype)

    def project(self, X_cam: np.ndarray) -> np.ndarray:
        """Project points of the camera frame with an ideal pinhole, without distortion.

        Args:
            X_cam: `(3, n)` points in camera axes, in meters; their depth `X_cam[2]` must not be 0.

        Returns:
            `(2, n)` pixels `(u, v)`, outside the image too.
        """
        x, y, z = X_cam
        return np.stack([self.fx * x / z + self.cx, self.fy * y / z + self.cy])

    def back_project(self, uv: np.ndarray, depth: np.ndarray) -> np.ndarray:
        """Return the points that an ideal pinhole, without distortion, projects to given pixels: `project` inverted.

        Args:
            uv: `(2, n)` pixels.
            depth: `(n,)` depth along the optical axis in meters.

        Returns:
            `(3, n)` points in camera axes, in meters. A depth of 1 gives the rays through the pixels.
        """
        u, v = uv
        return np.stack([(u - self.cx) / self.fx * depth, (v - self.cy) / self.fy * depth, depth])


def known_cameras() -> list[str]:
    """Return the names of the cameras that come with jaxslam."""
    return sorted(path.stem for path in _cameras_dir().glob("*.yaml"))


def _cameras_dir() -> Path:
    return configs_dir() / "cameras"


def check_axis(whose: str, axis: str, focal: float, center: float, extent: int) -> None:
    """Refuse a focal length that does not suit the image, or a principal point outside it.

    Args:
        whose: Prefix of the field name in the message.
        axis: `x` or `y`.
        focal: Focal length along that axis in pixels.
        center: Coordinate of the principal point along that axis in pixels.
        extent: Size of the image along that axis in pixels.

    Raises:
        CameraError: If either value is out of range.
    """
    shortest, longest = extent / 20, extent * 50  # a field of view of 169 and 1.1 degrees
    if not shortest <= focal <= longest:
        raise CameraError(
            f"{whose}.f{axis}: expected pixels that suit an image of {extent}, {shortest:g} to {longest:g},"
            f" got {focal:g} (millimeters, or relative to the width?)"
        )
    if not 0 < center < extent:
        raise CameraError(f"{whose}.c{axis}: expected a pixel inside the image, 0 to {extent}, got {center:g}")


def check_baseline(field: str, baseline_m: float) -> None:
    """Refuse a distance between two cameras that is probably in millimeters.

    Args:
        field: Name of the field in the message.
        baseline_m: Distance in meters.

    Raises:
        CameraError: If the distance is larger than `MAX_BASELINE_M`.
    """
    if baseline_m > MAX_BASELINE_M:
        raise CameraError(
            f"{field}: expected a baseline in meters, at most {MAX_BASELINE_M:g}, got {baseline_m:g} (millimeters?)"
        )


def _line(key: str, value: object) -> str:
    unit = f"  # {_UNITS[key]}" if key in _UNITS else ""
    return f"{key}: {json.dumps(value, ensure_ascii=False)}{unit}"
