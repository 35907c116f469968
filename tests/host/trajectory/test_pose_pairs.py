"""The RPE by the time of each pair: a drift of so much a second is that, however sparse or broken the poses are."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxslam.trajectory.evaluation import Evaluation, evaluate
from jaxslam.trajectory.trajectory import Trajectory, read

EPOCH_NS = 1_305_031_102_160_407_001
FRAME_S = 0.033


def _irregular() -> np.ndarray:
    return np.cumsum(np.random.default_rng(0).uniform(0.01, 1.7, 400))


def _broken() -> np.ndarray:
    return np.concatenate([FRAME_S * np.arange(400), 90 + FRAME_S * np.arange(400, 800)])


SAMPLINGS = {
    "each 33 ms": FRAME_S * np.arange(900),
    "each 0.4 s": 0.4 * np.arange(200),
    "each 5 s": 5.0 * np.arange(40),
    "irregular": _irregular(),
    "a gap of 90 s": _broken(),
}


def drifting(seconds: np.ndarray, m_per_s: float = 0.0, deg_per_s: float = 0.0) -> tuple[Trajectory, Trajectory]:
    """An estimate that drifts evenly, in position or in rotation, and the truth."""
    rng = np.random.default_rng(1)
    stamps = EPOCH_NS + np.round(1e9 * seconds).astype(np.int64)
    positions = np.column_stack([np.sin(0.7 * seconds), np.cos(0.4 * seconds), np.sin(0.3 * seconds + 1)])
    rotation = Rotation.identity(len(seconds)) if deg_per_s else Rotation.random(len(seconds), rng=rng)
    turned = Rotation.from_rotvec(np.outer(np.radians(deg_per_s) * seconds, [0.6, 0.0, 0.8])) * rotation
    make = lambda r, p: Trajectory(stamps, np.hstack([r.as_quat(scalar_first=True), p]))
    drift = np.outer(seconds, [m_per_s, 0, 0])
    if deg_per_s:
        positions = np.zeros_like(positions)
    return make(turned, positions + drift), make(rotation, positions)


@pytest.fixture(scope="module")
def moved() -> dict[str, Evaluation]:
    """Of a drift of 1 cm a second."""
    return {name: evaluate(*drifting(seconds, m_per_s=0.01)) for name, seconds in SAMPLINGS.items()}


class TestDrift:
    @pytest.mark.parametrize("sampling", SAMPLINGS)
    def test_in_position(self, moved: dict[str, Evaluation], sampling: str) -> None:
        assert "RPE  rmse 0.010000 m/s" in str(moved[sampling])
        assert moved[sampling].rpe_trans_m_per_s == pytest.approx(0.01, rel=1e-6)

    @pytest.mark.parametrize("sampling", SAMPLINGS)
    def test_in_rotation(self, sampling: str) -> None:
        result = evaluate(*drifting(SAMPLINGS[sampling], deg_per_s=0.5))
        assert "0.500000 deg/s" in str(result)
        assert result.rpe_trans_m_per_s == pytest.approx(0, abs=1e-9)


class TestLabel:
    @pytest.mark.parametrize(
        ("sampling", "pairs"),
        [
            ("each 33 ms", "869 pairs, 1.02 s apart"),
            ("each 0.4 s", "197 pairs, 1.20 s apart"),
            ("each 5 s", "39 pairs, 5.00 s apart"),
            ("a gap of 90 s", "769 pairs, 1.02 to 91.02 s apart, median 1.02 s"),
        ],
    )
    def test_says_how_far_apart_pairs_are(self, moved: dict[str, Evaluation], sampling: str, pairs: str) -> None:
        assert f"deg/s  ({pairs})" in str(moved[sampling])

    def test_of_pairs_of_frames(self, moved: dict[str, Evaluation]) -> None:
        assert "deg/frame  (899 pairs, 0.033 s apart)" in str(moved["each 33 ms"])
        assert "deg/frame  (799 pairs, 0.033 to 90.033 s apart, median 0.033 s)" in str(moved["a gap of 90 s"])

    def test_times_are_figures(self, moved: dict[str, Evaluation]) -> None:
        summary = moved["a gap of 90 s"].summary()
        stamps = np.round(1e9 * SAMPLINGS["a gap of 90 s"])
        later = np.searchsorted(stamps, stamps + 1e9)
        first = np.flatnonzero(later < len(stamps))
        seconds = (stamps[later[first]] - stamps[first]) / 1e9
        expected = (len(seconds), np.median(seconds), seconds.min(), seconds.max())
        names = ("rpe_pairs", "rpe_pair_s_median", "rpe_pair_s_min", "rpe_pair_s_max")
        assert [summary[name] for name in names] == pytest.approx(expected)
        names = ("rpe_frame_pairs", "rpe_frame_s_median", "rpe_frame_s_min", "rpe_frame_s_max")
        assert [summary[name] for name in names] == pytest.approx((799, 0.033, 0.033, 90.033))

    def test_without_pairs(self) -> None:
        result = evaluate(*drifting(FRAME_S * np.arange(5)))
        assert (result.rpe_pairs, result.rpe_pair_s_median, result.rpe_pair_s_max) == (0, None, None)
        assert result.rpe_spacing == "0 pairs"


class TestNotes:
    def test_none_where_poses_are_dense(self, moved: dict[str, Evaluation]) -> None:
        assert moved["each 33 ms"].notes == ()

    def test_sparse_poses(self, moved: dict[str, Evaluation]) -> None:
        (note,) = moved["each 5 s"].notes
        assert note.startswith("the poses are too sparse for an RPE over 1 s: the pairs are 5.00 s apart at the median")

    def test_gap(self, moved: dict[str, Evaluation]) -> None:
        """The pairs whose second pose should be in the gap: those that begin in the last second before it."""
        of_seconds, of_frames = moved["a gap of 90 s"].notes
        assert of_seconds == "31 of 769 pairs of the RPE over 1 s bridge gaps and are up to 91.02 s apart"
        assert of_frames.startswith(
            "1 of 799 pairs of the RPE per frame bridge gaps and are up to 90.03 s apart, while"
        )
        assert of_frames.endswith("most poses are 0.033 s apart")

    def test_sparse_poses_of_a_recording(self) -> None:
        """What is called a frame is many of them."""
        estimate, reference = drifting(SAMPLINGS["each 33 ms"], m_per_s=0.01)
        sparse = estimate.select(np.arange(0, 900, 60))
        notes = evaluate(sparse, reference, frames_ns=reference.timestamps_ns).notes
        assert any(
            note == "14 of 14 pairs of the RPE per frame bridge gaps and are up to 1.98 s apart, while frames are"
            " 0.033 s apart"
            for note in notes
        )

    @pytest.mark.slow
    def test_real_path_with_losses(self, data_dir: Path) -> None:
        """Ground truth of fr2_desk pauses, for up to 12 s."""
        estimate, reference = (
            read(data_dir / "trajectories" / f"fr2_desk_{name}.txt") for name in ("ORB", "groundtruth")
        )
        result = evaluate(estimate, reference)
        assert result.rpe_spacing == "2193 pairs, 1.00 to 12.96 s apart, median 1.00 s"
        assert "69 of 2193 pairs of the RPE over 1 s bridge gaps and are up to 12.96 s apart" in result.notes
