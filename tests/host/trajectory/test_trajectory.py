"""Trajectories: validation, interpolation, association by time, and the TUM and KITTI formats."""

import os
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation, Slerp

from jaxslam.errors import TrajectoryError
from jaxslam.geometry.so3 import matrices, quaternions, slerp
from jaxslam.trajectory.trajectory import (
    Trajectory,
    associate,
    read,
    read_euroc,
    read_kitti,
    read_tum,
    write_kitti,
    write_kitti_frames,
    write_tum,
)

EPOCH_NS = 1_305_031_102_160_407_001
IDENTITY = (1.0, 0, 0, 0, 0, 0, 0)


def make_trajectory(n=20, seed=0, start_ns=EPOCH_NS, step_ns=33_333_333):
    rng = np.random.default_rng(seed)
    wxyz = Rotation.random(n, rng=rng).as_quat(scalar_first=True)
    return Trajectory(start_ns + step_ns * np.arange(n), np.hstack([wxyz, rng.normal(size=(n, 3))]))


def assert_same_poses(actual, expected, atol=1e-9):
    sign = np.sign((actual.T_world_cam[:, :4] * expected.T_world_cam[:, :4]).sum(axis=1, keepdims=True))
    np.testing.assert_allclose(sign * actual.T_world_cam[:, :4], expected.T_world_cam[:, :4], atol=atol)
    np.testing.assert_allclose(actual.positions, expected.positions, atol=atol)


class TestTrajectory:
    def test_normalizes_copies_and_protects(self):
        stamps, poses = np.array([0, 1]), np.array([IDENTITY, (0.99, 0, 0, 0.01, 1, 2, 3)])
        trajectory = Trajectory(stamps, poses)
        poses[:] = 7
        np.testing.assert_allclose(np.linalg.norm(trajectory.T_world_cam[:, :4], axis=1), 1, atol=1e-15)
        np.testing.assert_array_equal(trajectory.positions, [[0, 0, 0], [1, 2, 3]])
        assert trajectory.timestamps_ns.dtype == np.int64
        with pytest.raises(ValueError, match="read-only"):
            trajectory.T_world_cam[0] = 0

    def test_may_be_empty(self):
        assert len(Trajectory(np.array([]), np.array([]))) == 0

    @pytest.mark.parametrize(
        ("stamps", "poses", "message"),
        [
            ([0.0, 1.0], [IDENTITY] * 2, r"timestamps_ns: expected \(n,\) integers in nanoseconds, got float64"),
            ([0, 1, 2], [IDENTITY] * 2, r"T_world_cam: expected shape \(3, 7\), got \(2, 7\)"),
            ([0], [(1.0, 0, 0, 0, 0, 0)], r"expected shape \(1, 7\), got \(1, 6\)"),
            ([], [IDENTITY], r"expected shape \(0, 7\)"),
            ([0, 1], [IDENTITY, (1, 0, 0, 0, 0, np.nan, 0)], "pose 1: holds a number that is not finite"),
            ([0, 1], [IDENTITY, (0.0,) * 7], "pose 1: the quaternion is not of unit length"),
            ([0, 1], [IDENTITY, (1, 0.5, 0, 0, 0, 0, 0)], "pose 1: the quaternion is not of unit length"),
            ([0, 5, 4], [IDENTITY] * 3, "pose 2: time goes backwards"),
        ],
    )
    def test_refuses(self, stamps, poses, message):
        with pytest.raises(TrajectoryError, match=message):
            Trajectory(stamps, poses)

    def test_at_interpolates_as_scipy(self):
        trajectory = make_trajectory(6)
        wanted = trajectory.timestamps_ns[0] + np.arange(0, 5 * 33_333_333, 7_654_321)
        seconds = (trajectory.timestamps_ns - EPOCH_NS) / 1e9
        reference = Slerp(seconds, Rotation.from_quat(trajectory.T_world_cam[:, :4], scalar_first=True))
        rotations = reference((wanted - EPOCH_NS) / 1e9).as_quat(scalar_first=True)
        positions = [np.interp((wanted - EPOCH_NS) / 1e9, seconds, axis) for axis in trajectory.positions.T]
        assert_same_poses(trajectory.at(wanted), Trajectory(wanted, np.column_stack([rotations, *positions])))

    def test_at_keeps_poses_and_holds_the_ends(self):
        trajectory = make_trajectory(5)
        ends = trajectory.timestamps_ns[[0, -1]] + [-10, 10]
        assert_same_poses(trajectory.at(trajectory.timestamps_ns), trajectory, atol=1e-15)
        assert_same_poses(trajectory.at(ends), Trajectory(ends, trajectory.T_world_cam[[0, -1]]))
        with pytest.raises(TrajectoryError, match="empty"):
            trajectory.select(np.zeros(5, bool)).at(ends)


class TestRotation:
    def test_matches_scipy_both_ways(self):
        rotations = Rotation.random(100, rng=np.random.default_rng(0))
        wxyz = rotations.as_quat(scalar_first=True, canonical=True)
        np.testing.assert_allclose(matrices(wxyz), rotations.as_matrix(), atol=1e-14)
        np.testing.assert_allclose(quaternions(rotations.as_matrix()), wxyz, atol=1e-13)

    def test_nearest_rotation_of_a_rounded_matrix(self):
        rounded = np.round(Rotation.random(50, rng=np.random.default_rng(1)).as_matrix(), 2)
        U, _, Vt = np.linalg.svd(rounded)
        np.testing.assert_allclose(matrices(quaternions(rounded)), U @ Vt, atol=1e-12)

    def test_slerp_of_equal_and_opposite_quaternions(self):
        q = np.array([[0.6, 0.8, 0, 0]])
        np.testing.assert_allclose(slerp(q, q, np.array([0.3])), q, atol=1e-15)
        np.testing.assert_allclose(slerp(q, -q, np.array([0.3])), q, atol=1e-15)


def _greedy(first, second, limit):
    """All pairs by gap, then with the first list's stamp the earlier, then by time; brute force."""
    first, second = sorted(set(first)), sorted(set(second))
    pairs = sorted((abs(a - b), a > b, a, b) for a in first for b in second if abs(a - b) <= limit)
    matched: dict[int, int] = {}
    for _, _, a, b in pairs:
        if a not in matched and b not in matched.values():
            matched[a] = b
    return sorted(matched.items())


class TestAssociate:
    @given(
        st.lists(st.integers(0, 60), max_size=25),
        st.lists(st.integers(0, 60), max_size=25),
        st.integers(0, 70),
    )
    @settings(max_examples=300, deadline=None)
    def test_matches_brute_force(self, first, second, limit):
        """Small integers, so that ties and repeated stamps are common."""
        i, j = associate(np.array(first, np.int64), np.array(second, np.int64), limit * 1e-9)
        found = [(first[a], second[b]) for a, b in zip(i, j, strict=True)]
        assert found == _greedy(first, second, limit)
        assert len(set(i)) == len(set(j)) == len(found)

    def test_nearest_wins_over_first(self):
        i, j = associate(np.array([0, 10]), np.array([9]), 20e-9)
        assert (i.tolist(), j.tolist()) == ([1], [0])

    def test_gap_is_inclusive_in_nanoseconds(self):
        stamps = np.array([EPOCH_NS])
        assert len(associate(stamps, stamps + 20_000_000, 0.02)[0]) == 1
        assert len(associate(stamps, stamps + 20_000_001, 0.02)[0]) == 0

    def test_halfway_stamps_pair_up_forward(self):
        """Every gap is the same: a chain of ties as long as the trajectory."""
        first = np.arange(100_000) * 2
        i, j = associate(first, first + 1, 1.0)
        np.testing.assert_array_equal(i, np.arange(100_000))
        np.testing.assert_array_equal(j, i)

    def test_of_equal_stamps_the_first_counts(self):
        i, j = associate(np.array([5, 5, 9]), np.array([5, 5, 5]), 0.0)
        assert (i.tolist(), j.tolist()) == ([0], [0])


class TestTum:
    def test_writes_the_format(self, tmp_path):
        stamps = np.array([-500_000_000, 0, EPOCH_NS])
        poses = np.array([IDENTITY, (0.5, 0.5, 0.5, 0.5, 1, 2, 3), (0.8, 0.6, 0, 0, -1e-9, 1e3, 0.25)])
        write_tum(tmp_path / "t.txt", Trajectory(stamps, poses))
        assert (tmp_path / "t.txt").read_bytes() == (
            b"-0.500000000 0.000000000 0.000000000 0.000000000 0.000000000 0.000000000 0.000000000 1.000000000\n"
            b"0.000000000 1.000000000 2.000000000 3.000000000 0.500000000 0.500000000 0.500000000 0.500000000\n"
            b"1305031102.160407001 -0.000000001 1000.000000000 0.250000000"
            b" 0.600000000 0.000000000 0.000000000 0.800000000\n"
        )

    def test_round_trip(self, tmp_path):
        trajectory = make_trajectory(50)
        write_tum(tmp_path / "t.txt", trajectory)
        for again in (read_tum(tmp_path / "t.txt"), read(tmp_path / "t.txt")):
            np.testing.assert_array_equal(again.timestamps_ns, trajectory.timestamps_ns)
            assert_same_poses(again, trajectory, atol=2e-9)

    def test_evo_reads_ours_and_we_read_evos(self, tmp_path):
        from evo.tools import file_interface  # noqa: PLC0415  GPL: in tests only

        trajectory = make_trajectory(50)
        write_tum(tmp_path / "ours.txt", trajectory)
        theirs = file_interface.read_tum_trajectory_file(tmp_path / "ours.txt")
        np.testing.assert_allclose(theirs.positions_xyz, trajectory.positions, atol=1e-9)
        np.testing.assert_allclose(theirs.orientations_quat_wxyz, trajectory.T_world_cam[:, :4], atol=2e-9)
        file_interface.write_tum_trajectory_file(tmp_path / "theirs.txt", theirs)
        again = read(tmp_path / "theirs.txt")
        exact = [round(Fraction(seconds) * 10**9) for seconds in theirs.timestamps]
        assert again.timestamps_ns.tolist() == exact
        assert_same_poses(again, trajectory, atol=2e-9)

    def test_reads_what_others_write(self, tmp_path):
        """A byte-order mark, comments, blank lines, tabs, trailing spaces, CRLF, exponents, no final newline."""
        (tmp_path / "t.txt").write_bytes(
            b"\xef\xbb\xbf# timestamp tx ty tz qx qy qz qw\r\n"
            b"1.305031102160407066e+09 1 2 3 0 0 0 1 \r\n\r\n  # more\n"
            b"1305031102.5\t1\t2e0\t3\t0\t0\t0\t-1"
        )
        trajectory = read_tum(tmp_path / "t.txt")
        assert trajectory.timestamps_ns.tolist() == [1305031102160407066, 1305031102500000000]
        np.testing.assert_array_equal(trajectory.positions, [[1, 2, 3]] * 2)

    @pytest.mark.parametrize(
        ("text", "message"),
        [
            ("1 0 0 0 0 0 0 1\n2 0 0 0 0 0 1\n", r"t\.txt:2: expected 8 columns .*, found 7: 2 0 0"),
            ("# nothing\n\n", r"t\.txt: holds no poses"),
            ("", r"t\.txt: holds no poses"),
            ("# c\n1 0 0 zero 0 0 0 1\n", r"t\.txt:2: expected 8 numbers .*'zero'"),
            ("one 0 0 0 0 0 0 1\n", r"t\.txt:1: expected 8 numbers .*'one'"),
            ("nan 0 0 0 0 0 0 1\n", r"t\.txt:1: holds a number that is not finite"),
            ("1 0 0 inf 0 0 0 1\n", r"t\.txt:1: holds a number that is not finite"),
            ("1 0 0 0 0 0 0 0\n", r"t\.txt:1: the quaternion is not of unit length"),
            ("2 0 0 0 0 0 0 1\n# c\n1 0 0 0 0 0 0 1\n", r"t\.txt:3: time goes backwards"),
            ("1305031102160407000 0 0 0 0 0 0 1\n", r"t\.txt:1: .* seconds, got '1305.*' \(nanoseconds\?\)"),
            ("1305031102160407 0 0 0 0 0 0 1\n", r"got '1305031102160407' \(microseconds\?\)$"),
            ("1305031102160 0 0 0 0 0 0 1\n", r"got '1305031102160' \(milliseconds\?\)$"),
            ("1e10 0 0 0 0 0 0 1\n", r"t\.txt:1: expected a timestamp in seconds, got '1e10'$"),
            ("1e99999999 0 0 0 0 0 0 1\n", r"t\.txt:1: holds a number that is not finite"),
            ("1e-9999999999999999999 0 0 0 0 0 0 1\n", r"t\.txt:1: expected a timestamp in seconds, got '1e-9+'$"),
            ("1,0,0,0,0,0,0,1\n", r"t\.txt:1: expected 8 \(TUM\) or 12 \(KITTI\) columns, found 1"),
            ("0 0 0 0 0 0 0 1\n1305031102 0 0 0 0 0 0 1\n", r"t\.txt: the timestamps span 41 years; are they all"),
        ],
    )
    def test_refuses(self, tmp_path, text, message):
        (tmp_path / "t.txt").write_text(text)
        with pytest.raises(TrajectoryError, match=message):
            read(tmp_path / "t.txt")

    def test_refuses_what_is_not_text(self, tmp_path):
        (tmp_path / "t.txt").write_bytes(b"\x89PNG\xff\xfe")
        for path in (tmp_path / "t.txt", tmp_path / "missing.txt", tmp_path):
            with pytest.raises(TrajectoryError, match="cannot be read"):
                read(path)

    def test_a_failed_write_leaves_the_old_file(self, tmp_path, monkeypatch):
        def fail(source, target):
            raise OSError("disk full")

        (tmp_path / "t.txt").write_text("old")
        monkeypatch.setattr(os, "replace", fail)
        with pytest.raises(TrajectoryError, match=r"t\.txt: cannot be written: disk full"):
            write_tum(tmp_path / "t.txt", make_trajectory(3))
        assert (tmp_path / "t.txt").read_text() == "old"
        assert os.listdir(tmp_path) == ["t.txt"]

    def test_refuses_to_write_nowhere(self, tmp_path):
        with pytest.raises(TrajectoryError, match="cannot be written"):
            write_tum(tmp_path / "missing" / "t.txt", make_trajectory(3))


class TestKitti:
    def test_round_trip(self, tmp_path):
        trajectory = make_trajectory(50, start_ns=0, step_ns=100_000_000)
        assert write_kitti(tmp_path / "k.txt", trajectory) == 0
        for again in (read_kitti(tmp_path / "k.txt"), read(tmp_path / "k.txt")):
            np.testing.assert_array_equal(again.timestamps_ns, trajectory.timestamps_ns)
            assert_same_poses(again, trajectory, atol=3e-9)

    def test_times(self, tmp_path):
        trajectory = make_trajectory(3)
        write_kitti(tmp_path / "k.txt", trajectory)
        (tmp_path / "times.txt").write_text("0.000000e+00\n1.037200e-01\n2.07\n")
        again = read_kitti(tmp_path / "k.txt", tmp_path / "times.txt")
        assert again.timestamps_ns.tolist() == [0, 103_720_000, 2_070_000_000]
        (tmp_path / "times.txt").write_text("0\n1\n")
        with pytest.raises(TrajectoryError, match=r"times\.txt: expected one stamp a pose, 3, got 2"):
            read_kitti(tmp_path / "k.txt", tmp_path / "times.txt")

    def test_one_row_a_frame(self, tmp_path):
        """Frames without a pose are filled in, and counted."""
        trajectory = make_trajectory(5, start_ns=0, step_ns=100_000_000)
        frames = np.arange(-1, 6) * 100_000_000
        assert write_kitti(tmp_path / "k.txt", trajectory.select(np.array([0, 2, 4])), frames) == 4
        filled = read_kitti(tmp_path / "k.txt")
        assert len(filled) == 7
        np.testing.assert_allclose(filled.positions[[0, 1, 3, 5, 6]], trajectory.positions[[0, 0, 2, 4, 4]], atol=1e-9)
        np.testing.assert_allclose(filled.positions[2], trajectory.positions[[0, 2]].mean(axis=0), atol=1e-9)

    def test_evo_reads_ours(self, tmp_path):
        from evo.tools import file_interface  # noqa: PLC0415  GPL: in tests only

        trajectory = make_trajectory(20)
        write_kitti(tmp_path / "k.txt", trajectory)
        theirs = file_interface.read_kitti_poses_file(tmp_path / "k.txt")
        np.testing.assert_allclose(theirs.positions_xyz, trajectory.positions, atol=1e-9)
        rotations = np.array(theirs.poses_se3)[:, :3, :3]
        np.testing.assert_allclose(rotations, matrices(trajectory.T_world_cam[:, :4]), atol=1e-9)

    @pytest.mark.parametrize(
        ("text", "message"),
        [
            ("1 0 0 0 0 1 0 0 0 0 1 0\n1 0 0 0 0 1 0 0 0 0 1\n", r"k\.txt:2: expected 12 columns .*, found 11"),
            ("1 0 0 0 0 1 0 0 0 0 -1 0\n", r"k\.txt:1: the 3 x 3 matrix is not a rotation"),
            ("2 0 0 0 0 2 0 0 0 0 2 0\n", r"k\.txt:1: the 3 x 3 matrix is not a rotation"),
            ("1 0 0 nan 0 1 0 0 0 0 1 0\n", r"k\.txt:1: holds a number that is not finite"),
            ("nan 0 0 0 0 1 0 0 0 0 1 0\n", r"k\.txt:1: holds a number that is not finite"),
        ],
    )
    def test_refuses(self, tmp_path, text, message):
        (tmp_path / "k.txt").write_text(text)
        with pytest.raises(TrajectoryError, match=message):
            read(tmp_path / "k.txt")


class TestEuroc:
    HEADER = "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z []\n"
    ROW = "1403636580838555648,1,2,3,0.8,0.6,0,0,0.1,0.2,0.3,0,0,0,0,0,0\n"

    @pytest.mark.parametrize(("name", "header"), [("data.csv", HEADER), ("data.csv", ""), ("truth.txt", HEADER)])
    def test_is_recognized(self, tmp_path, name, header):
        (tmp_path / name).write_text(header + self.ROW)
        for trajectory in (read(tmp_path / name), read_euroc(tmp_path / name)):
            assert trajectory.timestamps_ns.tolist() == [1403636580838555648]
            np.testing.assert_allclose(trajectory.T_world_cam, [[0.8, 0.6, 0, 0, 1, 2, 3]])

    def test_as_real_poses_are_in_tum_lines(self, data_dir, tmp_path):
        """Those of EuRoC's V1_03, in EuRoC's own columns: the order of the quaternion is another one."""
        tum = read(data_dir / "imu" / "euroc_V103" / "groundtruth.txt").select(np.arange(500))
        rows = (
            f"{stamp},{','.join(map(repr, pose[4:]))},{','.join(map(repr, pose[:4]))},0,0,0,0,0,0,0,0,0\n"
            for stamp, pose in zip(tum.timestamps_ns.tolist(), tum.T_world_cam.tolist(), strict=True)
        )
        (tmp_path / "data.csv").write_text(self.HEADER + "".join(rows))
        euroc = read(tmp_path / "data.csv")
        np.testing.assert_array_equal(euroc.timestamps_ns, tum.timestamps_ns)
        assert_same_poses(euroc, tum, atol=1e-15)

    @pytest.mark.parametrize(
        ("text", "message"),
        [
            ("1,2,3\n", r"data\.csv:2: expected at least 8 columns .*, got 3"),
            ("1403636580.8,1,2,3,1,0,0,0\n", r"data\.csv:2: expected nanoseconds, x y z and qw qx qy qz"),
            ("5,1,2,3,1,0,0,0\n4,1,2,3,1,0,0,0\n", r"data\.csv:3: time goes backwards"),
            ("5,1,nan,3,1,0,0,0\n", r"data\.csv:2: holds a number that is not finite"),
            ("5,1,2,3,2,0,0,0\n", r"data\.csv:2: the quaternion is not of unit length"),
        ],
    )
    def test_refuses(self, tmp_path, text, message):
        (tmp_path / "data.csv").write_text(self.HEADER + text)
        with pytest.raises(TrajectoryError, match=message):
            read(tmp_path / "data.csv")


@pytest.mark.parametrize(
    ("file", "poses", "first_ns"),
    [
        ("fr2_desk_groundtruth.txt", 20957, 1311868163869700000),
        ("freiburg1_xyz-rgbdslam.txt", 788, 1305031102160407000),
        ("KITTI_00_gt.txt", 4541, 0),
    ],
)
def test_reads_real_files(data_dir, file, poses, first_ns):
    trajectory = read(data_dir / "trajectories" / file)
    assert len(trajectory) == poses
    assert trajectory.timestamps_ns[0] == first_ns


class TestKittiFrames:
    def test_a_row_a_frame_from_the_first(self, tmp_path: Path) -> None:
        """Frames 0, 2 and 4 have no pose: the first begins with the next one, the others repeat the last."""
        half = np.sqrt(0.5)
        poses = np.array([[half, 0, half, 0, 5.0, 0, 0], [half, 0, half, 0, 6.0, 0, 0]])
        path = tmp_path / "poses.txt"
        filled = write_kitti_frames(path, Trajectory(np.array([1, 3]), poses), np.arange(5))
        read = read_kitti(path)
        assert (filled, len(read)) == (3, 5)
        np.testing.assert_allclose(read.positions, [[0, 0, 0]] * 3 + [[0, 0, 1]] * 2, atol=1e-9)
        np.testing.assert_allclose(read.T_world_cam[:, :4], [[1, 0, 0, 0]] * 5, atol=1e-9)

    def test_no_pose(self, tmp_path: Path) -> None:
        with pytest.raises(TrajectoryError, match="no pose to write"):
            write_kitti_frames(tmp_path / "poses.txt", Trajectory(np.zeros(0, int), np.zeros((0, 7))), np.arange(3))
