"""Two cameras side by side before rectification: an immutable record and its checks."""

from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal, TypeAlias

import numpy as np

from jaxslam.config.validation import Range, ValidatedConfig
from jaxslam.errors import CameraError, JaxSlamError
from jaxslam.sensors.camera import check_axis, check_baseline

LensModel: TypeAlias = Literal["radtan", "equidistant"]

_TERMS = {"radtan": (0, 4, 5), "equidistant": (0, 4)}
_MIN_BASELINE_M = 1e-4
_MAX_APART_DEG = 60.0
_Extent = Annotated[int, Range(at_least=8, at_most=32768)]
_Focal = Annotated[float, Range(above=0)]
_Pose: TypeAlias = tuple[float, float, float, float, float, float, float]


@dataclass(frozen=True)
class Lens(ValidatedConfig):
    """One camera of a pair before rectification.

    Attributes:
        width: Image width in pixels.
        height: Image height in pixels.
        fx: Horizontal focal length in pixels.
        fy: Vertical focal length in pixels.
        cx: Horizontal coordinate of the principal point in pixels, from the center of the top-left pixel.
        cy: Vertical coordinate of the principal point in pixels, from the center of the top-left pixel.
        distortion: Coefficients `(k1, k2, p1, p2)` or `(k1, k2, p1, p2, k3)` of `radtan`, `(k1, k2, k3, k4)` of
            `equidistant`; empty if the lens does not distort.
        model: Distortion model: `radtan`, OpenCV's radial-tangential one, or `equidistant`, its fisheye model (Kannala
            and Brandt).

    Raises:
        CameraError: If a value has the wrong type or is impossible.
    """

    width: _Extent
    height: _Extent
    fx: _Focal
    fy: _Focal
    cx: float
    cy: float
    distortion: tuple[float, ...] = ()
    model: LensModel = "radtan"

    _error: ClassVar[type[JaxSlamError]] = CameraError

    def __post_init__(self) -> None:
        super().__post_init__()
        check_axis("Lens", "x", self.fx, self.cx, self.width)
        check_axis("Lens", "y", self.fy, self.cy, self.height)
        if len(self.distortion) not in _TERMS[self.model]:
            wanted = " or ".join(str(count) for count in _TERMS[self.model] if count)
            raise CameraError(
                f"Lens.distortion: expected {wanted} numbers for {self.model}, got {len(self.distortion)}"
            )

    @property
    def matrix(self) -> np.ndarray:
        """`(3, 3)` float64 camera matrix."""
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1]])

    @property
    def terms(self) -> np.ndarray:
        """Distortion coefficients, `(5,)` or for a fisheye `(4,)` float64, padded with zeros."""
        count = _TERMS[self.model][-1]
        return np.array([*self.distortion, *[0.0] * (count - len(self.distortion))])


@dataclass(frozen=True)
class Rig(ValidatedConfig):
    """Two cameras side by side, as calibration describes them.

    Attributes:
        name: Name of the pair in messages.
        left: The left camera.
        right: The right camera, of the same image size and lens model.
        T_left_right: Pose `qw qx qy qz x y z` of the right camera in the axes of the left one, in meters; x is the
            baseline and must be positive. In ORB-SLAM3 it is `Stereo.T_c1_c2`.
        fps: Nominal pairs per second.
        far_depth_baselines: Depth beyond which a measured depth is not trusted on its own, in baselines (`ThDepth` of
            ORB-SLAM); `None` if unknown.

    Raises:
        CameraError: If a value has the wrong type, or the two cameras are not side by side.
    """

    name: str
    left: Lens
    right: Lens
    T_left_right: _Pose
    fps: Annotated[float, Range(above=0, at_most=100_000)] = 30.0
    far_depth_baselines: Annotated[float, Range(above=0)] | None = None

    _error: ClassVar[type[JaxSlamError]] = CameraError

    def __post_init__(self) -> None:
        super().__post_init__()
        for what in ("width", "height", "model"):
            left, right = getattr(self.left, what), getattr(self.right, what)
            if left != right:
                raise CameraError(f"rig '{self.name}': right.{what}: expected the left one's {left}, got {right}")
        length = float(np.linalg.norm(self.T_left_right[:4]))
        if abs(length - 1) > 0.01:
            raise CameraError(
                f"rig '{self.name}': T_left_right: expected a unit quaternion first, got one of {length:g}"
            )
        apart = np.degrees(2 * np.arccos(min(1.0, abs(self.T_left_right[0]) / length)))
        if apart > _MAX_APART_DEG:
            raise CameraError(
                f"rig '{self.name}': T_left_right: expected cameras that look the same way, got {apart:.0f} degrees"
                " apart"
            )
        x, y, z = self.T_left_right[4:]
        if np.linalg.norm((x, y, z)) < _MIN_BASELINE_M:
            raise CameraError(f"rig '{self.name}': T_left_right: expected a baseline in meters, got {x:g} {y:g} {z:g}")
        check_baseline(f"rig '{self.name}': T_left_right", float(np.linalg.norm((x, y, z))))
        if x <= max(abs(y), abs(z)):
            raise CameraError(
                f"rig '{self.name}': T_left_right: expected the right camera to the right of the left one (x of"
                f" {x:g} m larger than y and z of {y:g} and {z:g} m){_guess(x, y, z)}"
            )


def _guess(x: float, y: float, z: float) -> str:
    if -x > max(abs(y), abs(z)):
        return ": left and right swapped, or the transform the other way round?"
    return ": one above the other?" if abs(y) >= abs(z) else ": one behind the other?"
