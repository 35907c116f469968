"""Notes that name the likely cause of bad figures, each on the mistake it is about and not without it."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxslam.errors import TrajectoryError
from jaxslam.trajectory.evaluation import evaluate
from jaxslam.trajectory.trajectory import Trajectory, read

FILES = {
    "fr1_xyz": ("freiburg1_xyz-rgbdslam.txt", "freiburg1_xyz-groundtruth.txt"),
    "fr2_desk": ("fr2_desk_ORB.txt", "fr2_desk_groundtruth.txt"),
}


@pytest.fixture(scope="module", params=FILES)
def pair(request: pytest.FixtureRequest, data_dir: Path) -> tuple[Trajectory, Trajectory]:
    """Half a minute of a real estimate, and the truth."""
    estimate, reference = (read(data_dir / "trajectories" / name) for name in FILES[request.param])
    return estimate.select(np.arange(780)), reference


def swapped_order(trajectory: Trajectory) -> Trajectory:
    """As it is read from a file in which quaternions are written qw qx qy qz."""
    return Trajectory(trajectory.timestamps_ns, trajectory.T_world_cam[:, [3, 0, 1, 2, 4, 5, 6]])


def mounted(trajectory: Trajectory) -> Trajectory:
    """Of a marker that is turned on the camera."""
    turned = Rotation.from_quat(trajectory.T_world_cam[:, :4], scalar_first=True) * Rotation.from_rotvec([2, -1, 0.5])
    return Trajectory(trajectory.timestamps_ns, np.hstack([turned.as_quat(scalar_first=True), trajectory.positions]))


def about(notes: tuple[str, ...], *words: str) -> list[str]:
    """The notes that hold these words."""
    return [note for note in notes if all(word in note for word in words)]


def test_right_files_raise_no_suspicion(pair: tuple[Trajectory, Trajectory]) -> None:
    notes = evaluate(*pair).notes
    assert all("bridge gaps" in note or "estimated poses have a true pose" in note for note in notes)


class TestOrderOfQuaternions:
    def test_of_the_estimate(self, pair: tuple[Trajectory, Trajectory]) -> None:
        notes = evaluate(swapped_order(pair[0]), pair[1]).notes
        (note,) = about(notes, "the quaternions of the estimate seem to be in the order qw qx qy qz")
        right = evaluate(*pair).rpe_rot_deg_per_s
        told = float(note.partition("RPE would be ")[2].partition(" deg/s")[0])
        assert told == pytest.approx(right, rel=0.02)
        assert not about(notes, "marker")

    def test_of_the_reference(self, pair: tuple[Trajectory, Trajectory]) -> None:
        notes = evaluate(pair[0], swapped_order(pair[1])).notes
        assert about(notes, "the quaternions of the reference seem to be in the order qw qx qy qz")

    def test_of_another_body(self, pair: tuple[Trajectory, Trajectory]) -> None:
        """Both: the reference is of a marker on the camera, and the estimate is written in another order."""
        notes = evaluate(swapped_order(pair[0]), mounted(pair[1])).notes
        assert about(notes, "the rotations of the estimate fit, but for another body", "qw qx qy qz")

    def test_another_body_is_not_another_order(self, pair: tuple[Trajectory, Trajectory]) -> None:
        notes = evaluate(pair[0], mounted(pair[1])).notes
        assert about(notes, "marker")
        assert not about(notes, "qw qx qy qz")

    def test_rotations_that_nothing_explains(self, pair: tuple[Trajectory, Trajectory]) -> None:
        """Equal angles alone do not make another body: these turn about axes that wander."""
        estimate, reference = pair
        noise = Rotation.from_rotvec(np.random.default_rng(0).normal(size=(len(estimate), 3)))
        turned = Rotation.from_quat(estimate.T_world_cam[:, :4], scalar_first=True) * noise
        poses = np.hstack([turned.as_quat(scalar_first=True), estimate.positions])
        notes = evaluate(Trajectory(estimate.timestamps_ns, poses), reference).notes
        assert not about(notes, "marker")
        assert not about(notes, "qw qx qy qz")


class TestTimeOffset:
    @pytest.mark.parametrize("shift_s", [0.05, -0.3])
    def test_is_named(self, pair: tuple[Trajectory, Trajectory], shift_s: float) -> None:
        """By what to add, which then makes it as good as it was."""
        shifted = pair[0].shifted(shift_s)
        (note,) = about(evaluate(shifted, pair[1]).notes, "do the clocks differ?")
        added = float(note.partition("--time-offset ")[2].rstrip(")"))
        assert added == pytest.approx(-shift_s, abs=0.02)
        better, right = evaluate(shifted, pair[1], time_offset_s=added), evaluate(*pair)
        assert better.ate_rmse_m < 1.05 * right.ate_rmse_m
        assert not about(better.notes, "do the clocks differ?")
        assert f"{added:+.5g} s added to the stamps of the estimate" in better.title

    def test_auto(self, pair: tuple[Trajectory, Trajectory]) -> None:
        result, right = evaluate(pair[0].shifted(0.05), pair[1], time_offset_s="auto"), evaluate(*pair)
        assert result.time_offset_s == pytest.approx(-0.05, abs=0.02)
        assert result.summary()["time_offset_s"] == result.time_offset_s
        assert result.ate_rmse_m < 1.02 * right.ate_rmse_m

    def test_adds_up(self, pair: tuple[Trajectory, Trajectory]) -> None:
        """What is named is the whole offset, not what is missing to the one that was given."""
        result = evaluate(pair[0].shifted(0.4), pair[1], time_offset_s=-0.1)
        (note,) = about(result.notes, "do the clocks differ?")
        assert float(note.partition("--time-offset ")[2].rstrip(")")) == pytest.approx(-0.4, abs=0.02)

    def test_drift_is_no_offset(self, data_dir: Path) -> None:
        """The first 60 poses of KITTI 00: an offset of 0.4 s would halve the ATE, but the turns contradict it."""
        estimate, reference = (read(data_dir / "trajectories" / f"KITTI_00_{name}.txt") for name in ("ORB", "gt"))
        begin = estimate.select(np.arange(60))
        assert not about(evaluate(begin, reference).notes, "do the clocks differ?")
        result = evaluate(begin, reference, max_gap_s=0.06, time_offset_s="auto")
        assert about(result.notes, "the rotations do not agree much better with it")

    def test_where_nothing_matches(self, data_dir: Path) -> None:
        """Both have poses each 0.1 s, and the stamps of one fall between those of the other."""
        estimate, reference = (read(data_dir / "trajectories" / f"KITTI_00_{name}.txt") for name in ("ORB", "gt"))
        with pytest.raises(
            TrajectoryError, match=r"nearest are 50\.000 ms apart.*The positions fit best with --time-off"
        ):
            evaluate(estimate.shifted(0.05), reference)

    def test_no_overlap(self, pair: tuple[Trajectory, Trajectory]) -> None:
        begin = pair[1].timestamps_ns[0] * 1e-9
        since_start = Trajectory(pair[0].timestamps_ns - pair[0].timestamps_ns[0], pair[0].T_world_cam)
        with pytest.raises(TrajectoryError, match=rf"do not overlap in time; .*\({begin:.3f} would make both begin"):
            evaluate(since_start, pair[1])

    @pytest.mark.parametrize("offset", [float("nan"), "automatic"])
    def test_refuses(self, pair: tuple[Trajectory, Trajectory], offset: float) -> None:
        with pytest.raises(TrajectoryError, match="time_offset_s: expected seconds or 'auto', got"):
            evaluate(*pair, time_offset_s=offset)


class TestCounts:
    def test_swapped_files(self, pair: tuple[Trajectory, Trajectory]) -> None:
        notes = evaluate(pair[1], pair[0]).notes
        assert about(notes, f"the estimate has {len(pair[1])} poses", "were the estimate and the ground truth swapped?")
        (few,) = about(notes, "estimated poses have a true pose within 20 ms")
        assert few.startswith(f"only {evaluate(pair[1], pair[0]).num_matched} of {len(pair[1])} ")

    def test_swapped_files_where_nothing_matches(self, pair: tuple[Trajectory, Trajectory]) -> None:
        late = pair[0].shifted(5000.0)
        with pytest.raises(TrajectoryError, match=r"were the estimate and the ground truth swapped\?"):
            evaluate(pair[1], late)

    def test_few_matches(self, pair: tuple[Trajectory, Trajectory]) -> None:
        """Ground truth of a part of the estimate."""
        estimate, reference = pair
        part = reference.select(reference.timestamps_ns < estimate.timestamps_ns[300])
        result = evaluate(estimate, part)
        assert about(result.notes, f"only {result.num_matched} of 780 estimated poses")

    def test_sparse_estimate_is_not_swapped(self, pair: tuple[Trajectory, Trajectory]) -> None:
        assert not about(evaluate(pair[0].select(np.arange(0, 780, 20)), pair[1]).notes, "swapped")


class TestFrames:
    def test_of_another_recording(self, pair: tuple[Trajectory, Trajectory]) -> None:
        result = evaluate(*pair, frames_ns=pair[0].timestamps_ns + 10**13)
        assert result.coverage_percent == 0
        assert about(result.notes, "none of the 780 frames has an estimated pose within 20 ms")

    def test_sparse_poses_are_not_all_there_is(self, pair: tuple[Trajectory, Trajectory]) -> None:
        """Of the frames they cover few, and without the frames nobody can tell."""
        estimate, reference = pair
        sparse = estimate.select(np.arange(0, 780, 60))
        known, unknown = evaluate(sparse, reference, frames_ns=estimate.timestamps_ns), evaluate(sparse, reference)
        assert known.coverage_percent == pytest.approx(100 * 13 / 780)
        assert "1.7 % of 780 frames covered" in str(known)
        assert unknown.coverage_percent is unknown.summary()["coverage_percent"] is None
        assert "coverage unknown without the frames of the recording\n  estimated a pose each" in str(unknown)
        assert "100.0 %" not in str(known) + str(unknown)
