"""Stereo pairs: rough depth against measured truth, tracking of rendered and real pairs, and what does not fit."""

import dataclasses
from pathlib import Path

import cv2
import numpy as np
import pytest
from skimage.data import stereo_motorcycle

from jaxslam import Camera, Frame, Slam, TrackStatus, load_config
from jaxslam.datasets import open_dataset
from jaxslam.datasets.loaders.kitti import KittiDataset
from jaxslam.datasets.synthetic import SyntheticConfig, SyntheticDataset, write_tum
from jaxslam.errors import CameraError, DatasetError, FrameError
from jaxslam.features.orb import features_of
from jaxslam.mapping.local_mapping import mapping_plan
from jaxslam.sensors.frame_arrays import FrameMemory, frame_arrays
from jaxslam.sensors.sensor_model import sensor_model
from jaxslam.sensors.stereo_depth import RoughDepth
from jaxslam.trajectory.evaluation import evaluate

WIDTH, HEIGHT = 320, 240
PAIR = Camera("pair", WIDTH, HEIGHT, 300.0, 300.0, 159.5, 119.5, baseline_m=0.2)
DEPTH = dataclasses.replace(PAIR, baseline_m=None, depth_scale_per_m=5000.0)
GRAY = np.full((HEIGHT, WIDTH), 90, np.uint8)
METERS = np.ones((HEIGHT, WIDTH), np.float32)


def _settings(**track: object):
    return load_config("default", overrides=["semantics.model=null", *(f"track.{k}={v}" for k, v in track.items())])


def _room(baseline_m: float | None, frames: int = 40) -> SyntheticDataset:
    return SyntheticDataset(SyntheticConfig(frames=frames, people=0, path="xyz", baseline_m=baseline_m))


class TestFrame:
    def test_right_of_another_kind(self) -> None:
        with pytest.raises(
            FrameError, match=r"right: expected the shape of the left image, \(240, 320\), got \(240, 3"
        ):
            Frame(0, GRAY, right=np.zeros((HEIGHT, WIDTH, 3), np.uint8))
        with pytest.raises(FrameError, match=r"right: .* got float64"):
            Frame(0, GRAY, right=np.zeros((HEIGHT, WIDTH)))

    def test_camera_of_another_kind(self) -> None:
        for frame in (Frame(0, GRAY, METERS), Frame(0, GRAY)):
            with Slam(PAIR, _settings()) as slam, pytest.raises(FrameError, match="right: expected the right image"):
                slam.track(frame)
        with Slam(DEPTH, _settings()) as slam, pytest.raises(FrameError, match="depth_m: expected depth"):
            slam.track(Frame(0, GRAY, right=GRAY))

    def test_arrays_need_rough_depth(self) -> None:
        with pytest.raises(FrameError, match="depth for matching to begin with, got none"):
            frame_arrays(Frame(0, GRAY, right=GRAY), 0.1)
        arrays = frame_arrays(Frame(0, GRAY, METERS, right=GRAY), 0.1)
        held = FrameMemory(HEIGHT, WIDTH, pairs=True).hold(Frame(0, GRAY, METERS, right=GRAY), 0.1)
        np.testing.assert_array_equal(arrays.right, GRAY)
        np.testing.assert_array_equal(held.right, GRAY)


class TestRoughDepth:
    def test_of_a_real_pair(self) -> None:
        """Middlebury 2014: of three quarters of the pixels that have a disparity, 80 % within two pixels."""
        left, right, true = stereo_motorcycle()
        camera = Camera("motorcycle", left.shape[1], left.shape[0], 995.0, 995.0, 311.0, 254.0, baseline_m=0.193)
        depth = RoughDepth(camera).of(left, right)
        found = (depth > 0) & np.isfinite(true)
        disparity = 995.0 * 0.193 / np.where(found, depth, 1)
        assert depth.shape == true.shape
        assert depth.dtype == np.float32
        # Half the width for pairs of this size: what is nearer has more disparity than is sought.
        sought = np.isfinite(true) & (true < 2 * 32)
        assert found.sum() > 0.5 * sought.sum()
        assert np.mean(np.abs(disparity - true)[found] < 2) > 0.8

    @pytest.mark.parametrize(
        ("change", "message"),
        [({"baseline_m": None}, "baseline_m: expected meters"), ({"distortion": (0.1, 0, 0, 0, 0.0)}, "rectified")],
    )
    def test_cameras_that_are_no_pair(self, change: dict, message: str) -> None:
        with pytest.raises(CameraError, match=message):
            RoughDepth(dataclasses.replace(PAIR, **change))

    @pytest.mark.slow
    def test_features_are_matched(self) -> None:
        """Depth of features is matched, not read from the rough one: half the error, or less."""
        *pair, true = stereo_motorcycle()
        left, right = (cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) for image in pair)
        camera = Camera("motorcycle", left.shape[1], left.shape[0], 995.0, 995.0, 311.0, 254.0, baseline_m=0.193)
        rough = RoughDepth(camera).of(left, right)
        arrays = frame_arrays(Frame(0, left, rough, right=right), 0.1)
        features = features_of(arrays, np.zeros(6, np.float32), sensor_model(camera, _settings().track))
        column, row = features.uv_raw.round().astype(int)
        known = np.isfinite(true[row, column]) & (features.depth > 0) & (rough[row, column] > 0)
        errors = [
            np.abs(995.0 * 0.193 / depth[known] - true[row, column][known])
            for depth in (features.depth, rough[row, column])
        ]
        assert known.sum() > 300
        assert np.median(errors[0]) < 0.5 * np.median(errors[1])

    def test_nothing_to_see(self) -> None:
        assert not RoughDepth(PAIR).of(GRAY, GRAY).any()


class TestSettings:
    def test_noise_is_that_of_the_disparity(self) -> None:
        sensor = sensor_model(PAIR, _settings(disparity_sigma_px=0.6).track)
        assert sensor.baseline_m == pytest.approx(0.2)
        assert sensor.depth_sigma_per_m2 == pytest.approx(0.6 / 60)
        assert sensor.depth_sigma_m == 0
        assert sensor.max_depth_m == pytest.approx(15)

    def test_mapping_takes_the_same(self) -> None:
        """The map of a pair is adjusted with the noise of its disparity, not with that of a sensor of depth."""
        adjust = mapping_plan(PAIR, _settings(disparity_sigma_px=0.25)).adjust
        assert (adjust.depth_sigma_m, adjust.depth_sigma_per_m2) == (0.0, 0.25 / 60)
        measured = mapping_plan(DEPTH, _settings()).adjust
        assert (measured.depth_sigma_m, measured.depth_sigma_per_m2) == (0.005, 0.007)

    def test_far_depth_of_the_camera_file(self) -> None:
        assert sensor_model(dataclasses.replace(PAIR, far_depth_m=7.0), _settings().track).max_depth_m == 7

    def test_baseline_of_a_camera_that_measures_depth(self) -> None:
        """ORB-SLAM's files of RGB-D cameras have one too, of a pair that it pretends."""
        camera = dataclasses.replace(PAIR, depth_scale_per_m=5000.0)
        sensor = sensor_model(camera, _settings().track)
        assert not camera.is_stereo
        assert sensor.baseline_m == 0
        assert sensor.max_depth_m == _settings().track.max_depth_m


class TestRoom:
    def test_right_image_shows_the_room_from_the_right(self) -> None:
        """A point at depth z stands `fx b / z` further left in it."""
        dataset = _room(0.1, frames=1)
        frame = dataset.render(0)
        assert frame.right is not None
        v, u = np.mgrid[:480, :640].astype(np.float32)
        disparity = (dataset.fx * 0.1 / frame.exact_depth_m).astype(np.float32)
        gray, right = (cv2.GaussianBlur(image[..., 1], (0, 0), 1.5) for image in (frame.rgb, frame.right))
        back = cv2.remap(right, u - disparity, v, cv2.INTER_LINEAR)
        inner = np.s_[8:-8, 80:-8]
        difference = lambda image: np.mean(np.abs(image[inner].astype(float) - gray[inner]))
        assert difference(back) < 0.4 * difference(right)
        assert frame.measured.depth_m is None

    @pytest.mark.slow
    def test_every_frame_is_tracked(self) -> None:
        dataset = _room(0.1)
        with Slam(dataset.camera, _settings()) as slam:
            records = slam.run(dataset)
            error_m = evaluate(slam.trajectory, dataset.ground_truth).ate_rmse_m
            assert slam.warnings == ()
            slam.reset()
            swapped = dataclasses.replace(dataset[0], image=dataset[0].right, right=dataset[0].image)
            assert "left and right are swapped" in slam.track(swapped).warnings[0]
        assert [record.status for record in records[1:]] == [TrackStatus.OK] * (len(dataset) - 1)
        assert error_m < 0.002

    @pytest.mark.slow
    def test_without_looking_points_up(self) -> None:
        """A plan that follows points from keyframe to keyframe alone has none to match."""
        dataset = _room(0.1, frames=6)
        config = load_config("static", overrides=("semantics.model=null",))
        with Slam(dataset.camera, config) as slam:
            statuses = [slam.track(dataset[index]).status for index in range(len(dataset))]
        assert statuses[1:] == [TrackStatus.OK] * 5

    @pytest.mark.slow
    def test_black_pairs_in_between(self) -> None:
        dataset = _room(0.1, frames=16)
        black = np.zeros((480, 640, 3), np.uint8)
        with Slam(dataset.camera, _settings()) as slam:
            statuses = []
            for index in range(len(dataset)):
                frame = dataset[index]
                if index in (6, 7):
                    frame = dataclasses.replace(frame, image=black, right=black)
                statuses.append(slam.track(frame).status)
        assert statuses[6] == statuses[7] == TrackStatus.LOST
        assert TrackStatus.LOST not in statuses[8:]

    def test_is_not_written_as_tum(self, tmp_path: Path) -> None:
        with pytest.raises(DatasetError, match="expected a camera with depth images, got a stereo pair"):
            write_tum(_room(0.1, frames=1), tmp_path / "room")


def _kitti_folder(tmp_path: Path, frames: int = 3, color: bool = False) -> Path:
    """A folder in the layout of KITTI, with poses."""
    folder = tmp_path / "sequences" / "77"
    sides = ("image_2", "image_3") if color else ("image_0", "image_1")
    for shift, side in enumerate(sides):
        (folder / side).mkdir(parents=True)
        for index in range(frames):
            picture = np.random.default_rng(index).integers(0, 255, (48, 64), np.uint8)
            cv2.imwrite(str(folder / side / f"{index:06d}.png"), np.roll(picture, -4 * shift, axis=1))
    rows = {"P0": 0.0, "P1": -30.0, "P2": 6.0, "P3": -24.0}
    text = [f"{name}: 60 0 31.5 {number} 0 60 23.5 0 0 0 1 0" for name, number in rows.items()]
    (folder / "calib.txt").write_text("\n".join([*text, "Tr: 1 0 0 0 0 1 0 0 0 0 1 0"]))
    (folder / "times.txt").write_text("".join(f"{0.1 * index:e}\n" for index in range(frames)))
    (tmp_path / "poses").mkdir()
    poses = [f"1 0 0 0 0 1 0 0 0 0 1 {index}" for index in range(frames)]
    (tmp_path / "poses" / "77.txt").write_text("\n".join(poses))
    return folder


class TestKitti:
    def test_gray(self, tmp_path: Path) -> None:
        dataset = open_dataset(_kitti_folder(tmp_path))
        assert isinstance(dataset, KittiDataset)
        assert dataset.name == "kitti_77"
        camera = dataset.camera
        assert (camera.width, camera.height, camera.fx, camera.cx, camera.cy) == (64, 48, 60, 31.5, 23.5)
        assert camera.baseline_m == pytest.approx(0.5)
        assert camera.is_stereo
        np.testing.assert_array_equal(dataset.timestamps_ns, [0, 100_000_000, 200_000_000])
        frame = dataset[1]
        assert frame.right is not None
        assert frame.image.shape == frame.right.shape == (48, 64)
        np.testing.assert_array_equal(frame.right, np.roll(frame.image, -4, axis=1))
        assert dataset.ground_truth is not None
        np.testing.assert_allclose(dataset.ground_truth.positions, [[0, 0, 0], [0, 0, 1], [0, 0, 2]], atol=1e-12)

    def test_color(self, tmp_path: Path) -> None:
        """The left camera for color stands beside that of the poses: `K t = (6, 0, 0)`, 10 cm to the left."""
        dataset = open_dataset(_kitti_folder(tmp_path, color=True), "kitti")
        assert dataset[0].image.shape == (48, 64, 3)
        assert dataset.camera.baseline_m == pytest.approx(0.5)
        assert dataset.ground_truth is not None
        np.testing.assert_allclose(dataset.ground_truth.positions[1], [-0.1, 0, 1], atol=1e-12)

    def test_no_poses(self, tmp_path: Path) -> None:
        folder = _kitti_folder(tmp_path)
        (tmp_path / "poses" / "77.txt").unlink()
        assert open_dataset(folder).ground_truth is None

    @pytest.mark.parametrize(
        ("file", "text", "error", "message"),
        [
            ("calib.txt", "P0: 1 2 3", CameraError, r"calib.txt:1: expected 12 numbers"),
            ("calib.txt", "P0: 60 0 31.5 0 0 60 23.5 0 0 0 1 0", CameraError, "calib.txt: missing P1"),
            ("times.txt", "0.0\n0.1\n", DatasetError, "image_0: expected one image a line of times.txt, 2, got 3"),
            ("times.txt", "0.0\n0.2\n0.1\n", DatasetError, "times.txt: expected times that increase, frame 2 does not"),
            ("times.txt", "0.0\nnow\n0.1\n", DatasetError, "times.txt:2"),
        ],
    )
    def test_bad_text(self, tmp_path: Path, file: str, text: str, error: type[Exception], message: str) -> None:
        folder = _kitti_folder(tmp_path)
        (folder / file).write_text(text)
        with pytest.raises(error, match=message):
            open_dataset(folder)

    def test_bad_images(self, tmp_path: Path) -> None:
        folder = _kitti_folder(tmp_path)
        dataset = open_dataset(folder)
        (folder / "image_1" / "000001.png").write_bytes(b"no picture")
        with pytest.raises(DatasetError, match=r"000001\.png: expected an image"):
            dataset[1]
        cv2.imwrite(str(folder / "image_1" / "000002.png"), np.zeros((40, 64), np.uint8))
        with pytest.raises(DatasetError, match=r"expected 64x48 pixels, .* got 64x40"):
            dataset[2]
        (folder / "image_1" / "000002.png").rename(folder / "image_1" / "000003.png")
        with pytest.raises(DatasetError, match=r"000003\.png: expected the partner of 000002\.png"):
            open_dataset(folder)

    def test_depth_camera(self, tmp_path: Path) -> None:
        with pytest.raises(CameraError, match="baseline_m: expected meters for a stereo pair"):
            open_dataset(_kitti_folder(tmp_path), camera=dataclasses.replace(DEPTH, width=64, height=48, cx=30, cy=20))

    @pytest.mark.slow
    def test_real(self, data_dir: Path) -> None:
        """51 pairs from a car: every one tracked, and the length of the path right."""
        dataset = open_dataset(data_dir / "kitti" / "sequences" / "06")
        with Slam(dataset.camera, _settings()) as slam:
            records = slam.run(dataset)
            estimate = slam.trajectory
            assert slam.warnings == ()
        assert {record.status for record in records[1:]} == {TrackStatus.OK}
        assert dataset.ground_truth is not None
        lengths = [np.linalg.norm(t.positions[-1] - t.positions[0]) for t in (estimate, dataset.ground_truth)]
        assert lengths[0] == pytest.approx(lengths[1], rel=0.005)
        assert evaluate(estimate, dataset.ground_truth).ate_rmse_m < 0.3
