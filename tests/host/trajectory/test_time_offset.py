"""The offset between the clocks of two trajectories: on real ones shifted by a known time, and where it is not told."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxslam.errors import TrajectoryError
from jaxslam.trajectory.time_offset import estimate_time_offset
from jaxslam.trajectory.trajectory import Trajectory, read

FILES = {
    "fr1_xyz": ("freiburg1_xyz-rgbdslam.txt", "freiburg1_xyz-groundtruth.txt"),
    "fr2_desk": ("fr2_desk_ORB.txt", "fr2_desk_groundtruth.txt"),
    "KITTI 00": ("KITTI_00_ORB.txt", "KITTI_00_gt.txt"),
}


@pytest.fixture(scope="module", params=FILES)
def pair(request: pytest.FixtureRequest, data_dir: Path) -> tuple[Trajectory, Trajectory]:
    estimate, reference = (read(data_dir / "trajectories" / name) for name in FILES[request.param])
    return estimate, reference


def curve(seconds: np.ndarray) -> Trajectory:
    """A path that turns this way and that."""
    positions = np.column_stack([np.sin(2 * seconds), np.cos(1.3 * seconds), 0.2 * np.sin(5 * seconds)])
    turns = Rotation.from_rotvec(np.column_stack([np.sin(3 * seconds), 0.5 * np.cos(2 * seconds), 0 * seconds]))
    stamps = np.round(1e9 * seconds).astype(np.int64)
    return Trajectory(stamps, np.hstack([turns.as_quat(scalar_first=True), positions]))


class TestRealTrajectories:
    @pytest.mark.parametrize("shift_s", [0.05, -0.05, 0.7])
    def test_finds_what_was_added(self, pair: tuple[Trajectory, Trajectory], shift_s: float) -> None:
        """To a tenth of a millisecond, beside what the recording's own clocks differ by: 5 ms at most."""
        own = estimate_time_offset(*pair)
        assert abs(own.seconds) < 0.006
        found = estimate_time_offset(pair[0].shifted(shift_s), pair[1])
        assert found.seconds == pytest.approx(own.seconds - shift_s, abs=1e-4)
        assert found.with_it.ate_m == pytest.approx(own.with_it.ate_m, rel=1e-3)
        assert found.with_it.ate_m < found.without_it.ate_m
        assert found.with_it.turn_rad < found.without_it.turn_rad

    def test_either_way_round(self, pair: tuple[Trajectory, Trajectory]) -> None:
        """The denser of the two is interpolated, be it the reference or the estimate; of KITTI both are as dense."""
        there, back = estimate_time_offset(*pair), estimate_time_offset(pair[1], pair[0])
        even = len(pair[0]) == len(pair[1])
        assert back.seconds == pytest.approx(-there.seconds, abs=0.005 if even else 1e-4)

    def test_error_is_the_ate(self, data_dir: Path) -> None:
        """Poses of KITTI 00 have the same stamps, so that nothing is interpolated without an offset."""
        pair = [read(data_dir / "trajectories" / name).select(np.arange(1000)) for name in FILES["KITTI 00"]]
        P, Q = (trajectory.positions - trajectory.positions.mean(axis=0) for trajectory in pair)
        rotation = Rotation.align_vectors(Q, P)[0]
        rmse = np.sqrt(np.mean(np.sum((rotation.apply(P) - Q) ** 2, axis=1)))
        assert estimate_time_offset(pair[0], pair[1]).without_it.ate_m == pytest.approx(rmse, rel=1e-6)


class TestSettings:
    @pytest.mark.parametrize("align", ["none", "se3", "sim3"])
    def test_alignments(self, align: str) -> None:
        reference = curve(np.arange(0, 12, 0.01))
        estimate = curve(np.arange(1, 11, 0.05)).shifted(0.123)
        if align == "sim3":
            estimate = Trajectory(estimate.timestamps_ns, estimate.T_world_cam * np.array([1, 1, 1, 1, 3, 3, 3]))
        found = estimate_time_offset(estimate, reference, align)  # pyright: ignore[reportArgumentType]
        assert found.seconds == pytest.approx(-0.123, abs=5e-5)
        assert found.with_it.ate_m < 1e-3

    def test_poses_missing(self) -> None:
        """Nothing is interpolated across a gap of the reference, and some samples have no partner."""
        seconds = np.arange(0, 12, 0.01)
        reference = curve(seconds[(seconds < 4) | (seconds > 6)])
        estimate = curve(np.arange(1, 11, 0.05)).shifted(-0.04)
        assert estimate_time_offset(estimate, reference).seconds == pytest.approx(0.04, abs=5e-5)

    def test_range(self) -> None:
        reference, estimate = curve(np.arange(0, 12, 0.01)), curve(np.arange(1, 11, 0.05)).shifted(0.5)
        assert estimate_time_offset(estimate, reference, range_s=0.6).seconds == pytest.approx(-0.5, abs=5e-5)
        with pytest.raises(TrajectoryError, match=r"no offset up to 0\.2 s fits better than those around it"):
            estimate_time_offset(estimate, reference, range_s=0.2)

    def test_wider_than_an_offset_can_be_told(self) -> None:
        """At most a quarter of the time they share, which is 3.99 s."""
        reference, estimate = curve(np.arange(0, 6, 0.01)), curve(np.arange(0, 6, 0.05)).shifted(2.0)
        with pytest.raises(TrajectoryError, match=r"no offset up to 0\.9975 s fits"):
            estimate_time_offset(estimate, reference, range_s=5.0)


class TestRefuses:
    def test_no_time_shared(self) -> None:
        path = curve(np.arange(0, 6, 0.05))
        with pytest.raises(TrajectoryError, match="share too few poses"):
            estimate_time_offset(path.shifted(100.0), path)

    def test_too_few_poses(self) -> None:
        path = curve(np.arange(0, 6, 0.05))
        with pytest.raises(TrajectoryError, match="share too few poses"):
            estimate_time_offset(path.select(np.arange(0, 120, 15)), path)

    def test_single_pose(self) -> None:
        path = curve(np.arange(0, 6, 0.05))
        with pytest.raises(TrajectoryError, match="a single pose does not move"):
            estimate_time_offset(path.select(np.array([3])), path)

    def test_straight_and_even(self) -> None:
        """After alignment any offset is as good as another, so the first is the best: at the end of the range."""
        poses = np.zeros((200, 7))
        poses[:, 0], poses[:, 4] = 1, np.arange(200) * 0.25
        path = Trajectory(np.arange(200) * 50_000_000, poses)
        with pytest.raises(TrajectoryError, match="fits better than those around it"):
            estimate_time_offset(path, path)
