"""Consistency of a tracker: whether the errors of its poses are as large as its covariances say."""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float32, Float64

from jaxslam.errors import TrajectoryError
from jaxslam.geometry.se3 import between, displacement
from jaxslam.geometry.types import Poses, Timestamps
from jaxslam.trajectory.evaluation_figures import without_arrays
from jaxslam.trajectory.trajectory import Trajectory

_FAR_SIGMAS = 5.0
"""Standard deviations beyond which an error is not explained by its covariance: 1 in 1.7 million of normal errors."""


class RelativePoses(NamedTuple):
    """Poses of a camera relative to earlier poses of it, each with its covariance.

    Attributes:
        timestamps_ns: `(n,)` times of the poses, nanoseconds.
        reference_ns: `(n,)` times of the earlier poses that they are relative to, nanoseconds.
        T_reference_cam: `(n, 7)` float64 motions from the earlier pose to the pose, `wxyz_xyz`, meters.
        covariance: `(n, 6, 6)` covariances of the poses in the tangent space at the camera: translation (m), then
            rotation (rad).
    """

    timestamps_ns: Timestamps
    reference_ns: Timestamps
    T_reference_cam: Poses
    covariance: Float32[np.ndarray, "n 6 6"]


@dataclass(frozen=True, eq=False)
class Consistency:
    """Errors of poses beside their covariances: `str()` formats the figures, and `summary()` returns them for JSON.

    The normalized estimation error squared (NEES) of a pose is `eᵀ Σ⁻¹ e / 6`, with the error `e` of its motion from
    the reference pose and the covariance `Σ` that was given out. Its mean is 1 if covariances are right, more if they
    promise too much, and less if they promise too little (Bar-Shalom et al. 2001, section 5.4). Errors of the ground
    truth count too: motion capture that is good to a few millimeters, or that follows markers instead of the camera,
    says nothing about covariances of a millimeter.

    Attributes:
        num_poses: Number of poses that were compared with the ground truth.
        nees: Mean NEES of the poses.
        nees_translation: Mean NEES of the translations alone, of 3 degrees of freedom.
        nees_rotation: Mean NEES of the rotations alone, of 3 degrees of freedom.
        beyond_5_sigma_percent: Share of the poses with an error of more than 5 standard deviations along or about an
            axis of the camera, percent.
        timestamps_ns: `(m,)` times of the poses, nanoseconds.
        nees_of_pose: `(m,)` NEES of each pose.
        translation_error_m: `(m,)` errors of the translations, meters.
        translation_sigma_m: `(m,)` root of the trace of their covariances, meters.
        rotation_error_deg: `(m,)` errors of the rotations, degrees.
        rotation_sigma_deg: `(m,)` root of the trace of their covariances, degrees.
    """

    num_poses: int
    nees: float
    nees_translation: float
    nees_rotation: float
    beyond_5_sigma_percent: float
    timestamps_ns: Timestamps
    nees_of_pose: Float64[np.ndarray, " m"]
    translation_error_m: Float64[np.ndarray, " m"]
    translation_sigma_m: Float64[np.ndarray, " m"]
    rotation_error_deg: Float64[np.ndarray, " m"]
    rotation_sigma_deg: Float64[np.ndarray, " m"]

    def summary(self) -> dict[str, Any]:
        """All figures without the arrays, ready for JSON."""
        return without_arrays(self)

    def __str__(self) -> str:
        return (
            f"NEES {self.nees:.2f} (translation {self.nees_translation:.2f}, rotation {self.nees_rotation:.2f};"
            f" 1 is consistent), {self.beyond_5_sigma_percent:.1f} % of {self.num_poses} poses beyond 5 sigma"
        )


def evaluate_consistency(poses: RelativePoses, reference: Trajectory, *, max_gap_s: float = 0.02) -> Consistency | None:
    """Compare the errors of poses with their covariances; `None` if no pose has ground truth.

    Args:
        poses: Poses relative to earlier ones, with their covariances.
        reference: True trajectory, which is interpolated at the times of the poses.
        max_gap_s: Largest time from a pose to the nearest true pose, seconds; a pose that is farther away, or outside
            the time of the true trajectory, is left out.

    Raises:
        TrajectoryError: If a shape is wrong, or a covariance is not positive definite.
    """
    _check(poses)
    known = _has_truth(poses.timestamps_ns, reference, max_gap_s) & _has_truth(poses.reference_ns, reference, max_gap_s)
    if not known.any():
        return None
    true = between(*(_at(reference, stamps[known]) for stamps in (poses.reference_ns, poses.timestamps_ns)))
    error = displacement(true, poses.T_reference_cam[known])
    covariance = poses.covariance[known].astype(np.float64)
    if not (np.linalg.eigvalsh(covariance) > 0).all():
        raise TrajectoryError("covariance: expected positive definite matrices, got one that is not")
    variance = np.diagonal(covariance, axis1=1, axis2=2)
    translation, rotation = slice(0, 3), slice(3, 6)
    nees = _nees(error, covariance)
    return Consistency(
        num_poses=int(known.sum()),
        nees=float(nees.mean()),
        nees_translation=float(_nees(error[:, translation], covariance[:, translation, translation]).mean()),
        nees_rotation=float(_nees(error[:, rotation], covariance[:, rotation, rotation]).mean()),
        beyond_5_sigma_percent=100 * float(np.mean((error**2 > _FAR_SIGMAS**2 * variance).any(axis=1))),
        timestamps_ns=poses.timestamps_ns[known],
        nees_of_pose=nees,
        translation_error_m=np.linalg.norm(error[:, translation], axis=1),
        translation_sigma_m=np.sqrt(variance[:, translation].sum(axis=1)),
        rotation_error_deg=np.degrees(np.linalg.norm(error[:, rotation], axis=1)),
        rotation_sigma_deg=np.degrees(np.sqrt(variance[:, rotation].sum(axis=1))),
    )


def _check(poses: RelativePoses) -> None:
    """Check the shapes of poses."""
    n = len(poses.timestamps_ns)
    expected = {"reference_ns": (n,), "T_reference_cam": (n, 7), "covariance": (n, 6, 6)}
    for name, shape in expected.items():
        if (got := np.shape(getattr(poses, name))) != shape:
            raise TrajectoryError(f"{name}: expected shape {shape}, got {got}")


def _has_truth(timestamps_ns: Timestamps, reference: Trajectory, max_gap_s: float) -> np.ndarray:
    """`(n,)` true for times within the reference and close to one of its poses."""
    true_ns = reference.timestamps_ns
    if not len(true_ns):
        return np.zeros(len(timestamps_ns), bool)
    after = np.clip(np.searchsorted(true_ns, timestamps_ns), 0, len(true_ns) - 1)
    gap_ns = np.minimum(*(np.abs(true_ns[at] - timestamps_ns) for at in (np.maximum(after - 1, 0), after)))
    inside = (timestamps_ns >= true_ns[0]) & (timestamps_ns <= true_ns[-1])
    return inside & (gap_ns <= max_gap_s * 1e9)


def _at(reference: Trajectory, timestamps_ns: Timestamps) -> Poses:
    """True poses at times in any order."""
    stamps, which = np.unique(timestamps_ns, return_inverse=True)
    return reference.at(stamps).T_world_cam[which]


def _nees(error: Float64[np.ndarray, "m k"], covariance: Float64[np.ndarray, "m k k"]) -> Float64[np.ndarray, " m"]:
    """Squared errors normalized by their covariances and degrees of freedom."""
    return np.sum(error * np.linalg.solve(covariance, error[..., None])[..., 0], axis=1) / error.shape[1]
