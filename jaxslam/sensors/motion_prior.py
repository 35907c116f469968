"""The motion of a camera from one frame to the next, as something other than its images measured it."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float64

from jaxslam.errors import FrameError, brief_repr
from jaxslam.geometry.se3 import adjoint, compose, inverse
from jaxslam.geometry.types import Pose


@dataclass(frozen=True, eq=False)
class MotionPrior:
    """Motion of the camera since the frame before, measured by wheel odometry, a gyro or the arm that carries it.

    Attributes:
        T_last_cam: `(7,)` float64 wxyz_xyz pose of the camera at this frame in the axes of the camera at the frame
            before, meters.
        covariance: `(6, 6)` float64 covariance of the motion in the tangent space at the camera: translation (m), then
            rotation (rad). `(3, 3)` covariance of the rotation alone where translation was not measured; that of
            `T_last_cam` is then ignored.

    Raises:
        FrameError: If a field has another shape, is not finite, the quaternion has no length, or the covariance is not
            positive definite.
    """

    T_last_cam: Pose
    covariance: np.ndarray

    def __post_init__(self) -> None:
        motion, covariance = _numbers("T_last_cam", self.T_last_cam), _numbers("covariance", self.covariance)
        if motion.shape != (7,):
            raise FrameError(f"T_last_cam: expected (7,) wxyz_xyz, got shape {motion.shape}")
        length = np.linalg.norm(motion[:4])
        if not 0.9 < length < 1.1:
            raise FrameError(f"T_last_cam: expected a unit quaternion first, got one of length {length:g}")
        if covariance.shape not in ((6, 6), (3, 3)):
            raise FrameError(f"covariance: expected (6, 6), or (3, 3) of the rotation alone, got {covariance.shape}")
        covariance = 0.5 * (covariance + covariance.T)
        if (smallest := np.linalg.eigvalsh(covariance)[0]) <= 0:
            raise FrameError(f"covariance: expected a positive definite matrix, got the eigenvalue {smallest:g}")
        object.__setattr__(self, "T_last_cam", np.concatenate([motion[:4] / length, motion[4:]]))
        object.__setattr__(self, "covariance", covariance)

    @property
    def has_translation(self) -> bool:
        """True if translation was measured too, and not only rotation."""
        return self.covariance.shape == (6, 6)

    def then(self, after: "MotionPrior") -> "MotionPrior":
        """Return the motion over two intervals, of which this is the first; a rotation if one of them is."""
        T = compose(self.T_last_cam, after.T_last_cam)
        size = 6 if self.has_translation and after.has_translation else 3
        moved = _moved(self.covariance[-size:, -size:], after.T_last_cam)
        return MotionPrior(T, moved + after.covariance[-size:, -size:])

    def information_from(self, covariance: Float64[np.ndarray, "6 6"]) -> Float64[np.ndarray, "6 6"]:
        """Return what is known of the pose after the motion: the inverse covariance in the tangent space at the camera.

        It is 0 for translation that was not measured.

        Args:
            covariance: `(6, 6)` covariance of the pose before the motion, in the tangent space at the camera.
        """
        size = len(self.covariance)
        known = np.linalg.inv(_moved(covariance[-size:, -size:], self.T_last_cam) + self.covariance)
        information = np.zeros((6, 6))
        information[-size:, -size:] = 0.5 * (known + known.T)
        return information


def _moved(covariance: np.ndarray, T: Pose) -> np.ndarray:
    """Return a `(6, 6)` covariance, or `(3, 3)` of a rotation, in the tangent space after a motion, by its adjoint."""
    # The last three rows and columns of the adjoint are those of rotations alone.
    moves = adjoint(inverse(T))[-len(covariance) :, -len(covariance) :]
    return moves @ covariance @ moves.T


def _numbers(name: str, given: Any) -> np.ndarray:
    try:
        numbers = np.array(given, np.float64)
    except (TypeError, ValueError):
        raise FrameError(f"{name}: expected an array of floats, got {brief_repr(given)}") from None
    if not np.isfinite(numbers).all():
        raise FrameError(f"{name}: expected finite numbers, got {brief_repr(given)}")
    return numbers
