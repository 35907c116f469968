"""An estimate and a reference from files: stamps for rows of KITTI, frames beside the ground truth, unsorted rows."""

from pathlib import Path

import numpy as np
import pytest

from jaxslam.datasets.evaluation_files import read_frames, read_pair
from jaxslam.errors import TrajectoryError
from jaxslam.trajectory.trajectory import Trajectory, write_kitti, write_tum

STAMPS = 10**9 * np.array([3, 4, 6, 7, 9], np.int64)


def path_of(poses: int = 5) -> Trajectory:
    T = np.zeros((poses, 7))
    T[:, 0], T[:, 4] = 1, np.arange(poses)
    return Trajectory(STAMPS[:poses], T)


def write_times(path: Path, seconds: list[float]) -> Path:
    path.write_text("".join(f"{second}\n" for second in seconds))
    return path


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Five and four poses in both formats, each in a folder of its own, and their times."""
    for name, poses in (("estimate", 4), ("truth", 5)):
        (tmp_path / name).mkdir()
        write_tum(tmp_path / name / "tum.txt", path_of(poses))
        write_kitti(tmp_path / name / "kitti.txt", path_of(poses))
    (tmp_path / "lists").mkdir()
    write_times(tmp_path / "lists" / "five.txt", [3, 4, 6, 7, 9])
    write_times(tmp_path / "lists" / "four.txt", [3, 4, 6, 7])
    return tmp_path


class TestKitti:
    def test_rows_of_different_length_have_no_stamps(self, folder: Path) -> None:
        message = r"rows of KITTI have no stamps, and .*estimate/kitti.txt 4 .*truth/kitti.txt 5 .*--times FILE gives"
        with pytest.raises(TrajectoryError, match=message):
            read_pair(folder / "estimate/kitti.txt", folder / "truth/kitti.txt")

    @pytest.mark.parametrize(("estimate", "truth"), [("kitti", "tum"), ("tum", "kitti")])
    def test_against_stamps_needs_times(self, folder: Path, estimate: str, truth: str) -> None:
        paths = folder / f"estimate/{estimate}.txt", folder / f"truth/{truth}.txt"
        with pytest.raises(
            TrajectoryError, match=r"rows of KITTI have no stamps to match .*\(TUM\).*--times FILE gives"
        ):
            read_pair(*paths)
        times = folder / "lists" / ("four.txt" if estimate == "kitti" else "five.txt")
        pair = read_pair(*paths, times=[times])
        np.testing.assert_array_equal(pair.estimate.timestamps_ns, STAMPS[:4])
        np.testing.assert_array_equal(pair.reference.timestamps_ns, STAMPS)
        assert pair.notes == ()

    def test_equal_length_is_matched_by_row(self, folder: Path) -> None:
        pair = read_pair(folder / "truth/kitti.txt", folder / "truth/kitti.txt")
        assert pair.reference.timestamps_ns.tolist() == [0, 10**8, 2 * 10**8, 3 * 10**8, 4 * 10**8]
        (note,) = pair.notes
        assert note.startswith("rows of KITTI have no stamps: matched by row, as if 0.1 s apart; --times FILE gives")

    def test_times_of_each(self, folder: Path) -> None:
        times = [folder / "lists" / name for name in ("four.txt", "five.txt")]
        pair = read_pair(folder / "estimate/kitti.txt", folder / "truth/kitti.txt", times=times)
        np.testing.assert_array_equal(pair.estimate.timestamps_ns, STAMPS[:4])
        np.testing.assert_array_equal(pair.reference.timestamps_ns, STAMPS)

    def test_times_of_both(self, folder: Path) -> None:
        pair = read_pair(folder / "truth/kitti.txt", folder / "truth/kitti.txt", times=[folder / "lists/five.txt"])
        for trajectory in (pair.estimate, pair.reference):
            np.testing.assert_array_equal(trajectory.timestamps_ns, STAMPS)

    @pytest.mark.parametrize(
        ("estimate", "truth", "times", "message"),
        [
            ("kitti", "kitti", ["five.txt"], r"expected one stamp a row of .*estimate/kitti.txt, 4, got 5; two files"),
            ("kitti", "tum", ["four.txt"] * 2, r"expected a file for rows of KITTI, 1 at most, got 2: .*\(TUM\)"),
            ("tum", "tum", ["five.txt"], r"expected a file for rows of KITTI, 0 at most, got 1"),
        ],
    )
    def test_times_that_do_not_fit(
        self, folder: Path, estimate: str, truth: str, times: list[str], message: str
    ) -> None:
        paths = folder / f"estimate/{estimate}.txt", folder / f"truth/{truth}.txt"
        with pytest.raises(TrajectoryError, match=message):
            read_pair(*paths, times=[folder / "lists" / name for name in times])


class TestFrames:
    def test_beside_the_ground_truth(self, folder: Path) -> None:
        assert read_pair(folder / "estimate/tum.txt", folder / "truth/tum.txt").frames_ns is None
        write_times(folder / "truth/times.txt", [3, 4, 5, 6])
        (folder / "truth/rgb.txt").write_text("# color images\n3.5 rgb/1.png\n4.5 rgb/2.png\n")
        pair = read_pair(folder / "estimate/tum.txt", folder / "truth/tum.txt")
        assert pair.frames_ns is not None
        assert pair.frames_ns.tolist() == [3_500_000_000, 4_500_000_000]
        assert pair.notes == (f"frames are those of {folder / 'truth/rgb.txt'}, beside the ground truth",)

    def test_that_are_asked_for(self, folder: Path) -> None:
        write_times(folder / "truth/times.txt", [1, 2])
        pair = read_pair(folder / "estimate/tum.txt", folder / "truth/tum.txt", frames=folder / "lists/five.txt")
        np.testing.assert_array_equal(pair.frames_ns, STAMPS)
        assert pair.notes == ()

    def test_give_stamps_to_as_many_rows(self, folder: Path) -> None:
        """As KITTI's times.txt does, which lies in the folder of the recording."""
        write_times(folder / "truth/times.txt", [3, 4, 6, 7, 9])
        pair = read_pair(folder / "truth/kitti.txt", folder / "truth/kitti.txt")
        for stamps in (pair.estimate.timestamps_ns, pair.reference.timestamps_ns, pair.frames_ns):
            np.testing.assert_array_equal(stamps, STAMPS)
        assert pair.notes[1] == f"rows of KITTI have the stamps of {folder / 'truth/times.txt'}"
        pair = read_pair(folder / "estimate/tum.txt", folder / "truth/kitti.txt")
        np.testing.assert_array_equal(pair.reference.timestamps_ns, STAMPS)

    def test_of_another_number_than_rows(self, folder: Path) -> None:
        """Found ones are left out with a word; those asked for are an error."""
        paths = folder / "truth/kitti.txt", folder / "truth/kitti.txt"
        with pytest.raises(TrajectoryError, match=r"--frames .*expected as many stamps as .* rows of KITTI, 5, got 4"):
            read_pair(*paths, frames=folder / "lists/four.txt")
        write_times(folder / "truth/times.txt", [1, 2])
        pair = read_pair(*paths)
        assert pair.frames_ns is None
        assert f"{folder / 'truth/times.txt'} lists 2 frames and is not used" in pair.notes[-1]

    def test_malformed_list_that_was_found(self, folder: Path) -> None:
        (folder / "truth/rgb.txt").write_text("once upon a time\n")
        pair = read_pair(folder / "estimate/tum.txt", folder / "truth/tum.txt")
        assert pair.frames_ns is None
        assert pair.notes[0].startswith("frames beside the ground truth are not used: ")
        assert "rgb.txt:1" in pair.notes[0]

    def test_real_lists(self, data_dir: Path) -> None:
        assert len(read_frames(data_dir / "kitti/sequences/06/times.txt")) == 51
        frames = read_frames(data_dir / "bonn/rgbd_bonn_crowd/rgb.txt")
        assert frames[0] == 1548339819_874260000
        assert len(frames) > 100

    def test_nothing_there(self, folder: Path) -> None:
        (folder / "none.txt").write_text("# none\n")
        for name in ("none.txt", "missing.txt"):
            with pytest.raises(TrajectoryError, match=name):
                read_frames(folder / name)


class TestOrder:
    def test_rows_are_sorted(self, folder: Path) -> None:
        path = folder / "estimate/tum.txt"
        lines = path.read_text().splitlines()
        path.write_text("\n".join(lines[index] for index in (2, 0, 3, 1)))
        pair = read_pair(path, folder / "truth/tum.txt")
        np.testing.assert_array_equal(pair.estimate.timestamps_ns, STAMPS[:4])
        np.testing.assert_array_equal(pair.estimate.positions[:, 0], np.arange(4))
        assert pair.notes == (
            "the rows of the estimate were not in the order of time (2 steps back) and have been sorted",
        )

    def test_of_equal_stamps_the_first_row_stays_first(self, folder: Path) -> None:
        path = folder / "estimate/tum.txt"
        path.write_text("4 1 0 0 0 0 0 1\n3 2 0 0 0 0 0 1\n4 3 0 0 0 0 0 1\n")
        pair = read_pair(path, folder / "truth/tum.txt")
        assert pair.estimate.positions[:, 0].tolist() == [2, 1, 3]

    def test_line_of_a_bad_row(self, folder: Path) -> None:
        path = folder / "truth/tum.txt"
        path.write_text("4 1 0 0 0 0 0 1\n3 2 0 0 0 0 0 9\n")
        with pytest.raises(TrajectoryError, match=r"tum\.txt:2: the quaternion is not of unit length"):
            read_pair(folder / "estimate/tum.txt", path)
