"""Recordings of TUM, Bonn, KITTI and EuRoC as they are unpacked: opened, checked, tracked, and broken in all ways."""

import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from public_layouts import (
    ABSENT,
    COLOR_ONLY,
    DEPTH_LATER_NS,
    EUROC_SIZE,
    KITTI_SIZES,
    gray_picture,
    kitti_focal_center_baseline,
    write_euroc,
    write_kitti,
    write_rgbd,
)

from jaxslam import Camera
from jaxslam.cli.entry_point import main
from jaxslam.datasets import Associated, frames_with_depth, open_dataset, prefetch
from jaxslam.datasets.catalog import find_recording, known_recordings
from jaxslam.datasets.diagnostics import Level, diagnose
from jaxslam.datasets.loaders.euroc import EurocDataset
from jaxslam.datasets.registry import layout_of
from jaxslam.datasets.synthetic import SyntheticConfig, SyntheticDataset
from jaxslam.errors import DatasetError, TrajectoryError
from jaxslam.sensors.frame import to_gray
from jaxslam.trajectory.trajectory import Trajectory

COUNT = 14
START_NS = 1_341_846_313_553_990_000
TIMES_NS = [START_NS + 33_360_000 * index for index in range(COUNT)]
CAMERAS = {
    "rgbd_dataset_freiburg1_desk": ("tum", "tum_fr1"),
    "rgbd_dataset_freiburg2_desk_with_person": ("tum", "tum_fr2"),
    "rgbd_dataset_freiburg3_sitting_halfsphere": ("tum", "tum_fr3"),
    "rgbd_dataset_freiburg3_walking_xyz": ("tum", "tum_fr3"),
    "rgbd_bonn_kidnapping_box2": ("bonn", "bonn"),
}


def _still(times_ns: list[int]) -> Trajectory:
    return Trajectory(np.array([times_ns[0], times_ns[-1]]), np.tile([1.0, 0, 0, 0, 1.3, 0.6, 1.5], (2, 1)))


def _rgbd(folder: Path) -> Path:
    colors = [np.repeat(gray_picture(index, (640, 480))[..., None], 3, 2) for index in range(COUNT)]
    depths_m = [np.full((480, 640), 1.0 + 0.1 * index, np.float32) for index in range(COUNT)]
    return write_rgbd(folder, TIMES_NS, colors, depths_m, _still(TIMES_NS))


def found_as(name: str, root: Path) -> Path:
    folder = find_recording(name, root)
    assert folder is not None
    return folder


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording of each sensor of TUM, and one of Bonn."""
    root = tmp_path_factory.mktemp("unpacked")
    first, *others = (root / name for name in CAMERAS)
    _rgbd(first)
    for other in others:
        if other.name.startswith("rgbd_bonn_"):
            _rgbd(root / "rgbd_bonn_dataset" / other.name)
        else:
            shutil.copytree(first, other)
    return root


@pytest.fixture
def broken(written: Path, tmp_path: Path) -> Path:
    """A copy of a recording, to break, in folders as the page of TUM names it."""
    return Path(shutil.copytree(written / "rgbd_dataset_freiburg3_walking_xyz", tmp_path / "fr3" / "walking_xyz"))


class TestRgbd:
    @pytest.mark.parametrize("name", CAMERAS)
    def test_opens_under_its_name(self, written: Path, name: str) -> None:
        kind, camera = CAMERAS[name]
        assert name in known_recordings()
        folder = found_as(name, written)
        assert layout_of(folder).kind == kind
        dataset = open_dataset(folder)
        assert (dataset.name, dataset.camera) == (name, Camera.load(camera))
        assert dataset.camera.depth_scale_per_m == 5000

    @pytest.mark.parametrize("name", ["rgbd_dataset_freiburg3_walking_xyz", "rgbd_bonn_kidnapping_box2"])
    def test_images_without_depth_are_frames(self, written: Path, name: str) -> None:
        """Left out are a color image before any depth, and a depth image after the last color image."""
        folder = found_as(name, written)
        dataset = open_dataset(folder)
        without = {COLOR_ONLY - 1, ABSENT - 1} if "bonn" in name else {COLOR_ONLY - 1}
        assert dataset.timestamps_ns.tolist() == TIMES_NS[1:]
        assert set(np.flatnonzero(~frames_with_depth(dataset))) == without
        assert isinstance(dataset, Associated)
        assert dataset.unmatched == (1, 1)
        for index, frame in enumerate(prefetch(dataset)):
            assert frame.size == (640, 480)
            assert (frame.depth_m is None) == (index in without)
            if frame.depth_m is not None:
                assert frame.depth_delay_ns == DEPTH_LATER_NS
                np.testing.assert_allclose(frame.depth_m, 1.0 + 0.1 * (index + 1), atol=1e-4)
            else:
                assert frame.depth_timestamp_ns is None

    def test_ground_truth(self, written: Path) -> None:
        truth = open_dataset(written / "rgbd_dataset_freiburg1_desk").ground_truth
        assert truth is not None
        assert np.diff(truth.timestamps_ns).tolist() == [10_000_000] * (len(truth) - 1)
        np.testing.assert_allclose(truth.T_world_cam[0], [1, 0, 0, 0, 1.3, 0.6, 1.5])

    def test_doctor_tells_frames_without_depth(self, written: Path) -> None:
        diagnosis = diagnose(written / "rgbd_bonn_dataset" / "rgbd_bonn_kidnapping_box2")
        (finding,) = [finding for finding in diagnosis.findings if finding.topic == "depth images"]
        assert finding.text.startswith("2 of 13 frames have no depth image")
        assert finding.level is Level.WARNING
        whole = diagnose(written / "rgbd_dataset_freiburg1_desk")
        assert diagnosis.ok
        assert whole.ok

    def test_many_missing_depth_images_are_an_error(self, broken: Path) -> None:
        for file in sorted((broken / "depth").iterdir())[:2]:
            file.unlink()
        with pytest.raises(DatasetError, match=r"depth/\d+\.\d+\.png: listed but missing, one of 2 such images"):
            open_dataset(broken, camera="tum_fr3")


class TestBroken:
    @pytest.mark.parametrize(("gone", "there"), [("rgb.txt", "depth.txt"), ("depth.txt", "rgb.txt")])
    def test_list_missing(self, broken: Path, gone: str, there: str) -> None:
        (broken / gone).unlink()
        message = f"{broken.resolve() / gone}: expected it beside {there}, got none"
        with pytest.raises(DatasetError, match=re.escape(message)):
            open_dataset(broken)

    def test_times_alone_are_no_part_of_kitti(self, tmp_path: Path) -> None:
        (tmp_path / "times.txt").write_text("0\n1\n")
        with pytest.raises(DatasetError, match=r"expected a recording of kind .* got a folder without those files$"):
            open_dataset(tmp_path)

    def test_folder_above(self, broken: Path) -> None:
        with pytest.raises(DatasetError, match="without those files; a recording in it is walking_xyz"):
            open_dataset(broken.parent)

    @pytest.mark.parametrize(
        ("text", "error", "message"),
        [
            ("", TrajectoryError, "groundtruth.txt: holds no poses"),
            ("# timestamp tx ty tz qx qy qz qw\n", TrajectoryError, "groundtruth.txt: holds no poses"),
            ("1.0 0 0 0 0 0 1\n", TrajectoryError, "groundtruth.txt:1: expected 8 columns"),
            ("1.0 0 0 0 0 0 0 1 0\n", TrajectoryError, "groundtruth.txt:1: expected 8 columns"),
            ("0 0 1 1.0 0.6 1.5 0 1341846313.5\n", TrajectoryError, "groundtruth.txt:1: the quaternion is not of unit"),
        ],
    )
    def test_ground_truth(self, broken: Path, text: str, error: type[Exception], message: str) -> None:
        (broken / "groundtruth.txt").write_text(text)
        with pytest.raises(error, match=message):
            _ = open_dataset(broken, camera="tum_fr3").ground_truth

    def test_columns_of_a_list_swapped(self, broken: Path) -> None:
        path = broken / "depth.txt"
        path.write_text("".join(f"{b} {a}\n" for a, b in map(str.split, path.read_text().splitlines()[3:])))
        with pytest.raises(DatasetError, match=r"depth\.txt:1: expected a timestamp in seconds, got 'depth/"):
            open_dataset(broken, camera="tum_fr3")

    def test_lists_swapped(self, broken: Path) -> None:
        color, depth = broken / "rgb.txt", broken / "depth.txt"
        texts = color.read_text(), depth.read_text()
        color.write_text(texts[1])
        depth.write_text(texts[0])
        with pytest.raises(DatasetError, match=r"rgb/\S+: expected depth as one uint16 a pixel, got 3 x uint8"):
            open_dataset(broken, camera="tum_fr3")[0]

    @pytest.mark.filterwarnings("ignore")
    @pytest.mark.parametrize("kind", ["rgb", "depth"])
    def test_image_cut_short(self, broken: Path, kind: str) -> None:
        file = sorted((broken / kind).iterdir())[1]
        file.write_bytes(file.read_bytes()[:300])
        with pytest.raises(DatasetError, match=f"{file.name}: expected an image, got 300 bytes that cannot be decoded"):
            list(prefetch(open_dataset(broken, camera="tum_fr3")))


class TestKitti:
    @pytest.mark.parametrize(
        ("number", "group"), [("00", "00"), ("02", "00"), ("03", "03"), ("10", "04"), ("12", "04")]
    )
    def test_each_group_has_its_camera(self, tmp_path: Path, number: str, group: str) -> None:
        size = KITTI_SIZES[group]
        pairs = [(gray_picture(index, size), gray_picture(index + 1, size)) for index in range(2)]
        truth = np.tile([1.0, 0, 0, 0, 0, 0, 0], (2, 1)) if number < "11" else None
        write_kitti(tmp_path / "dataset", number, group, pairs, truth)
        folder = found_as(f"kitti_{number}", tmp_path)
        dataset = open_dataset(folder)
        f, cx, cy, baseline_m = kitti_focal_center_baseline(group)
        camera = dataset.camera
        assert (dataset.name, camera.width, camera.height, camera.fps) == (f"kitti_{number}", *size, 10)
        np.testing.assert_allclose((camera.fx, camera.fy, camera.cx, camera.cy), (f, f, cx, cy))
        assert camera.baseline_m == pytest.approx(baseline_m)
        assert 0.53 < baseline_m < 0.54
        assert dataset.timestamps_ns.tolist() == [0, 103_700_000]
        assert (dataset.ground_truth is None) == (number >= "11")
        frame = dataset[1]
        assert frame.right is not None
        np.testing.assert_array_equal(frame.image, pairs[1][0])
        np.testing.assert_array_equal(frame.right, pairs[1][1])

    @pytest.mark.parametrize("gone", ["calib.txt", "times.txt"])
    def test_archive_not_unpacked(self, tmp_path: Path, gone: str) -> None:
        """Images, calibration and times come in two archives, poses in a third one."""
        pair = gray_picture(0, KITTI_SIZES["03"]), gray_picture(1, KITTI_SIZES["03"])
        folder = write_kitti(tmp_path, "03", "03", [pair], None)
        (folder / gone).unlink()
        with pytest.raises(DatasetError, match=rf"03/{gone}: expected it beside image_0, got none"):
            open_dataset(folder)

    def test_empty_poses(self, tmp_path: Path) -> None:
        pair = gray_picture(0, KITTI_SIZES["03"]), gray_picture(1, KITTI_SIZES["03"])
        folder = write_kitti(tmp_path, "03", "03", [pair, pair], np.tile([1.0, 0, 0, 0, 0, 0, 0], (2, 1)))
        poses = tmp_path / "poses" / "03.txt"
        for text, message in (
            ("", "03.txt: holds no poses"),
            (poses.read_text().splitlines()[0], "one stamp a pose, 1"),
        ):
            poses.write_text(text)
            with pytest.raises(TrajectoryError, match=message):
                _ = open_dataset(folder).ground_truth


class TestEuroc:
    @pytest.fixture
    def flight(self, tmp_path: Path) -> Path:
        times_ns = [1_413_394_887_005_760_512 + 50_000_128 * index for index in range(3)]
        return write_euroc(tmp_path / "V2_03_difficult", times_ns, left_without_right=1)

    def test_opens(self, flight: Path) -> None:
        found = found_as("V2_03_difficult", flight.parent)
        assert found == flight
        assert "V2_03_difficult" in known_recordings()
        dataset = open_dataset(found)
        assert isinstance(dataset, EurocDataset)
        assert (dataset.name, len(dataset), dataset.unmatched) == ("V2_03_difficult", 2, (1, 0))
        camera = dataset.camera
        assert (camera.width, camera.height, camera.fps) == (*EUROC_SIZE, 20)
        assert camera.baseline_m == pytest.approx(47.90639384423901 / 435.2046959714599)  # ORB-SLAM2's EuRoC.yaml
        assert np.abs(np.array([camera.fx, camera.fy]) - 436).max() < 30
        frame = dataset[1]
        assert frame.size == EUROC_SIZE
        assert frame.right is not None
        assert frame.imu is not None
        assert len(frame.imu) == 20  # of 100 ms, as the pair between is missing

    def test_ground_truth_starts_later(self, flight: Path) -> None:
        dataset = open_dataset(flight)
        assert dataset.ground_truth is not None
        assert dataset.ground_truth.timestamps_ns[0] > dataset.timestamps_ns[0]
        assert dataset.ground_truth.timestamps_ns[-1] <= dataset.timestamps_ns[-1]

    def test_list_of_one_camera_missing(self, flight: Path) -> None:
        (flight / "mav0" / "cam1" / "data.csv").unlink()
        message = r"mav0/cam1/data\.csv: expected it beside mav0/cam0/data\.csv, got none"
        with pytest.raises(DatasetError, match=message):
            open_dataset(flight)


@pytest.mark.slow
class TestTracked:
    """Rendered through the published calibration, and tracked by the command that users type."""

    def _summary(self, folder: Path, out: Path) -> dict:
        main(["run", str(folder), "--out", str(out), "--set", "semantics.model=null"])
        return json.loads((out / "summary.json").read_text())

    @pytest.mark.parametrize("name", ["rgbd_dataset_freiburg3_walking_xyz", "rgbd_bonn_crowd3"])
    def test_rgbd(self, tmp_path: Path, name: str) -> None:
        """Bonn's lens, which distorts by a pixel in the corners, is rendered without distortion."""
        camera = Camera.load("bonn" if "bonn" in name else "tum_fr3")
        room = SyntheticDataset(
            SyntheticConfig(frames=16, people=1, fx=camera.fx, fy=camera.fy, cx=camera.cx, cy=camera.cy)
        )
        frames = [room.render(index) for index in range(len(room))]
        times_ns = [int(stamp) // 10_000 * 10_000 for stamp in room.timestamps_ns]
        truth = Trajectory(room.timestamps_ns, room.T_world_cam)
        folder = write_rgbd(
            tmp_path / name, times_ns, [frame.rgb for frame in frames], [frame.depth_m for frame in frames], truth
        )
        summary = self._summary(folder, tmp_path / "out")
        assert summary["frames"] == summary["tracked"] == 15
        assert summary["evaluation"]["ate_rmse_m"] < 0.01

    def test_kitti(self, tmp_path: Path) -> None:
        f, cx, cy, baseline_m = kitti_focal_center_baseline("04")
        width, height = KITTI_SIZES["04"]
        room = SyntheticDataset(
            SyntheticConfig(
                frames=10, people=0, width=width, height=height, fps=10, fx=f, cx=cx, cy=cy, baseline_m=baseline_m
            )
        )
        frames = [room.render(index) for index in range(len(room))]
        pairs = [(to_gray(frame.rgb), to_gray(frame.right)) for frame in frames if frame.right is not None]
        folder = write_kitti(tmp_path, "04", "04", pairs, room.T_world_cam)
        summary = self._summary(folder, tmp_path / "out")
        assert summary["frames"] == summary["tracked"] == 10
        assert summary["evaluation"]["ate_rmse_m"] < 0.02
