"""Consistency: NEES of errors that are drawn from their covariances, and of those that are not."""

from dataclasses import replace

import numpy as np
import pytest

from jaxslam.errors import TrajectoryError
from jaxslam.geometry.se3 import between, retract
from jaxslam.trajectory.consistency import Consistency, RelativePoses, evaluate_consistency
from jaxslam.trajectory.trajectory import Trajectory

STEP_NS = 50_000_000
COUNT = 600


def way(count: int = COUNT) -> Trajectory:
    """A camera that moves and turns."""
    generator = np.random.default_rng(1)
    poses = [np.array([1.0, 0, 0, 0, 0, 0, 0])]
    for _ in range(count):
        poses.append(retract(poses[-1], generator.normal(0, 0.05, 6)))
    return Trajectory(STEP_NS * np.arange(count + 1), np.array(poses))


def covariances(count: int = COUNT) -> np.ndarray:
    """Full covariances of about 1 mm and 0.1 degrees."""
    roots = np.random.default_rng(2).normal(0, 1, (count, 6, 9)) * np.repeat([1e-3, 2e-3], 3)[:, None] / 3
    return roots @ roots.swapaxes(1, 2)


def drawn(factor: float = 1.0) -> tuple[RelativePoses, Trajectory]:
    """Motions with errors of a factor times the deviations that their covariances have, and the true way."""
    truth, covariance = way(), covariances()
    generator = np.random.default_rng(3)
    errors = factor * np.einsum("nij,nj->ni", np.linalg.cholesky(covariance), generator.normal(size=(COUNT, 6)))
    true = between(truth.T_world_cam[:-1], truth.T_world_cam[1:])
    motions = np.array([retract(pose, error) for pose, error in zip(true, errors, strict=True)])
    stamps = truth.timestamps_ns
    return RelativePoses(stamps[1:], stamps[:-1], motions, covariance.astype(np.float32)), truth


def evaluated(poses: RelativePoses, truth: Trajectory) -> Consistency:
    found = evaluate_consistency(poses, truth)
    assert found is not None
    return found


@pytest.mark.parametrize("factor", [0.3, 1.0, 3.0])
def test_nees_is_the_squared_factor(factor: float) -> None:
    """Its mean over 600 poses of 6 degrees of freedom has a deviation of 2.4 %, over 3 degrees 3.3 %."""
    found = evaluated(*drawn(factor))
    assert found.num_poses == COUNT
    assert found.nees == pytest.approx(factor**2, rel=0.1)
    assert found.nees_translation == pytest.approx(factor**2, rel=0.13)
    assert found.nees_rotation == pytest.approx(factor**2, rel=0.13)
    assert found.nees == pytest.approx(found.nees_of_pose.mean())
    lengths = np.mean(found.translation_error_m**2) / np.mean(found.translation_sigma_m**2)
    assert lengths == pytest.approx(factor**2, rel=0.2)
    turns = np.mean(found.rotation_error_deg**2) / np.mean(found.rotation_sigma_deg**2)
    assert turns == pytest.approx(factor**2, rel=0.2)
    assert (found.beyond_5_sigma_percent > 0) == (factor == 3)


def test_counts_what_is_far() -> None:
    poses, truth = drawn(0.1)
    far = np.arange(0, COUNT, 50)
    motions = poses.T_reference_cam.copy()
    motions[far, 4] += 6 * np.sqrt(poses.covariance[far, 0, 0])
    found = evaluated(poses._replace(T_reference_cam=motions), truth)
    assert found.beyond_5_sigma_percent == pytest.approx(100 * len(far) / COUNT)
    np.testing.assert_array_equal(np.sort(np.argsort(-found.translation_error_m / found.translation_sigma_m)[:12]), far)


def test_true_poses_are_interpolated() -> None:
    poses, truth = drawn()
    denser = truth.at(np.arange(0, truth.timestamps_ns[-1] + 1, STEP_NS // 5))
    shifted = denser.select(denser.timestamps_ns % STEP_NS != 0)  # none at the times of the poses
    assert evaluated(poses, denser).nees == pytest.approx(evaluated(poses, truth).nees, rel=1e-6)
    inside = evaluated(poses, shifted)
    assert inside.num_poses == COUNT - 2  # the first and the last are outside
    assert inside.nees != evaluated(poses, truth).nees


def test_poses_without_truth_are_left_out() -> None:
    poses, truth = drawn()
    half = truth.select(np.arange(COUNT // 2))
    found = evaluated(poses, half)
    assert found.num_poses == COUNT // 2 - 1
    np.testing.assert_array_equal(found.timestamps_ns, half.timestamps_ns[1:])
    assert evaluate_consistency(poses, truth.shifted(1e6)) is None
    assert evaluate_consistency(poses, truth.select(np.arange(0))) is None
    sparse = truth.select(np.arange(0, COUNT, 10))
    assert evaluate_consistency(poses, sparse) is None  # of two successive poses, one is never close to a true one


def test_summary_and_text() -> None:
    found = evaluated(*drawn())
    assert list(found.summary()) == [
        *("num_poses", "nees", "nees_translation", "nees_rotation", "beyond_5_sigma_percent"),
    ]
    text = str(replace(found, nees=1.234, num_poses=7))
    assert text.startswith("NEES 1.23 (translation ")
    assert text.endswith("0.0 % of 7 poses beyond 5 sigma")


@pytest.mark.parametrize(
    ("field", "value", "words"),
    [
        ("reference_ns", np.zeros(3, np.int64), r"reference_ns: expected shape \(600,\), got \(3,\)"),
        ("T_reference_cam", np.zeros((600, 6)), r"T_reference_cam: expected shape \(600, 7\), got \(600, 6\)"),
        (
            "covariance",
            np.zeros((600, 3, 3), np.float32),
            r"covariance: expected shape \(600, 6, 6\), got \(600, 3, 3\)",
        ),
        ("covariance", np.zeros((600, 6, 6), np.float32), "covariance: expected positive definite matrices"),
    ],
)
def test_refuses(field: str, value: np.ndarray, words: str) -> None:
    poses, truth = drawn()
    with pytest.raises(TrajectoryError, match=words):
        evaluate_consistency(poses._replace(**{field: value}), truth)
