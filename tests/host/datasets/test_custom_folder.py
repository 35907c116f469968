"""Folders of one's own images, and those of TartanAir."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from raw_pairs import RADTAN

from jaxslam import Camera, RectifiedPair, Rig
from jaxslam.datasets import open_dataset
from jaxslam.errors import CameraError, DatasetError, TrajectoryError
from jaxslam.sensors.stereo_rig import Lens

WIDTH, HEIGHT = 64, 48
DEPTH = Camera("mine", WIDTH, HEIGHT, 60.0, 60.0, 31.5, 23.5, depth_scale_per_m=1000.0, fps=20.0)
PAIR = Camera("pair", WIDTH, HEIGHT, 60.0, 60.0, 31.5, 23.5, baseline_m=0.2, fps=20.0)
LENS = Lens(WIDTH, HEIGHT, 42.0, 42.0, 31.0, 24.0, RADTAN[0].distortion)
RIG = Rig("rig", LENS, LENS, (1, 0, 0, 0, 0.1, 0, 0))


def _images(folder: Path, names: list[str], seed: int = 0, size: tuple[int, int] = (HEIGHT, WIDTH)) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for index, name in enumerate(names):
        pixels = np.random.default_rng(seed + index).integers(0, 255, (*size, 3), np.uint8)
        cv2.imwrite(str(folder / f"{name}.png"), pixels)


def _depths(folder: Path, names: list[str], counts: int = 1500) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for name in names:
        cv2.imwrite(str(folder / f"{name}.png"), np.full((HEIGHT, WIDTH), counts, np.uint16))


NAMES = ["1", "2", "10"]


class TestFolder:
    def test_color_and_depth(self, tmp_path: Path) -> None:
        """Numbers in the order of their value, times by the rate of the camera, depth in meters."""
        _images(tmp_path / "color", NAMES)
        _depths(tmp_path / "depth", NAMES)
        dataset = open_dataset(tmp_path, camera=DEPTH)
        np.testing.assert_array_equal(dataset.timestamps_ns, [0, 50_000_000, 100_000_000])
        frame = dataset[2]
        np.testing.assert_array_equal(frame.image[..., ::-1], cv2.imread(str(tmp_path / "color" / "10.png")))
        assert frame.depth_m is not None
        np.testing.assert_allclose(frame.depth_m, 1.5)

    def test_depth_in_meters(self, tmp_path: Path) -> None:
        _images(tmp_path / "rgb", ["a"])
        (tmp_path / "depth").mkdir()
        plane = np.full((HEIGHT, WIDTH), 2.5)
        plane[0, :3] = np.nan, -1, np.inf
        np.save(tmp_path / "depth" / "a.npy", plane)
        depth_m = open_dataset(tmp_path, camera=DEPTH)[0].depth_m
        assert depth_m is not None
        assert depth_m.dtype == np.float32
        assert (depth_m[0, :3].tolist(), float(depth_m[1, 1])) == ([0, 0, 0], 2.5)

    def test_pair_as_the_cameras_are(self, tmp_path: Path) -> None:
        _images(tmp_path / "left", NAMES)
        _images(tmp_path / "right", NAMES, seed=9)
        straight, raw = open_dataset(tmp_path, camera=RectifiedPair(RIG)), open_dataset(tmp_path, camera=PAIR)
        assert straight.camera.baseline_m == pytest.approx(0.1)
        assert raw.camera == PAIR
        assert raw[0].right is not None
        expected, _ = RectifiedPair(RIG).images(raw[0].image, raw[0].right)
        np.testing.assert_array_equal(straight[0].image, expected)

    @pytest.mark.parametrize(
        ("names", "times", "expected"),
        [
            (["1600000000000000001", "1600000000000000005"], None, [1600000000000000001, 1600000000000000005]),
            (["12.25", "12.5"], None, [12_250_000_000, 12_500_000_000]),
            (["a", "b"], "0.5\n0.75\n", [500_000_000, 750_000_000]),
        ],
    )
    def test_times(self, tmp_path: Path, names: list[str], times: str | None, expected: list[int]) -> None:
        _images(tmp_path / "left", names)
        _images(tmp_path / "right", names)
        if times is not None:
            (tmp_path / "times.txt").write_text(times)
        assert open_dataset(tmp_path, camera=PAIR).timestamps_ns.tolist() == expected

    def test_ambiguous(self, tmp_path: Path) -> None:
        _images(tmp_path / "rgb", NAMES)
        _depths(tmp_path / "depth", NAMES)
        with pytest.raises(CameraError, match="give --camera"):
            open_dataset(tmp_path)
        with pytest.raises(CameraError, match=r"expected one with depth for .*, got a stereo pair"):
            open_dataset(tmp_path, camera=PAIR)
        (tmp_path / "times.txt").write_text("1\n2\n")
        with pytest.raises(DatasetError, match="expected one time an image, 3, got 2"):
            open_dataset(tmp_path, camera=DEPTH)
        (tmp_path / "times.txt").write_text("1\n3\n2\n")
        with pytest.raises(DatasetError, match="times that increase, frame 2 does not"):
            open_dataset(tmp_path, camera=DEPTH)
        (tmp_path / "times.txt").unlink()
        _images(tmp_path / "rgb", ["12.25"])
        with pytest.raises(DatasetError, match="expected as many images as in rgb, 4, got 3"):
            open_dataset(tmp_path, camera=DEPTH)
        _depths(tmp_path / "depth", ["12.25"])
        with pytest.raises(DatasetError, match="expected every name to be a time as others are, got '1'"):
            open_dataset(tmp_path, camera=DEPTH)
        np.save(tmp_path / "depth" / "a.npy", np.ones((HEIGHT, WIDTH)))
        with pytest.raises(DatasetError, match=r"expected depth as \.png or as \.npy, got both"):
            open_dataset(tmp_path, camera=DEPTH)
        _images(tmp_path / "color", NAMES)
        with pytest.raises(DatasetError, match="got rgb and color and depth"):
            open_dataset(tmp_path, camera=DEPTH)


def _tartanair(folder: Path) -> Path:
    names = ["000000_left", "000001_left"]
    _images(folder / "image_left", names, size=(480, 640))
    _images(folder / "image_right", ["000000_right", "000001_right"], seed=5, size=(480, 640))
    (folder / "depth_left").mkdir()
    for name in names:
        depth = np.full((480, 640), 3.0, np.float32)
        depth[:100] = 20_000
        np.save(folder / "depth_left" / f"{name}_depth.npy", depth)
    (folder / "pose_left.txt").write_text("1 2 3 0 0 0 1\n2 2 3 0 0 0.7071068 0.7071068\n")
    return folder


class TestTartanAir:
    def test_depth(self, tmp_path: Path) -> None:
        dataset = open_dataset(_tartanair(tmp_path / "P001"))
        assert (dataset.name, len(dataset), dataset.camera.is_stereo) == ("P001", 2, False)
        depth_m = dataset[0].depth_m
        assert depth_m is not None
        assert (float(depth_m[50, 50]), float(depth_m[200, 50])) == (0, 3)

    def test_poses_in_axes_of_opencv(self, tmp_path: Path) -> None:
        """A meter forward is one along z; a turn to the right (about down) is one about y."""
        truth = open_dataset(_tartanair(tmp_path / "P001")).ground_truth
        assert truth is not None
        np.testing.assert_allclose(truth.positions, [[2, 3, 1], [2, 3, 2]])
        np.testing.assert_allclose(truth.T_world_cam[1, :4], [np.sqrt(0.5), 0, np.sqrt(0.5), 0], atol=1e-6)

    def test_stereo(self, tmp_path: Path) -> None:
        folder = _tartanair(tmp_path / "P001")
        dataset = open_dataset(folder, "tartanair_stereo")
        assert dataset.camera.baseline_m == 0.25
        assert dataset[1].right is not None
        for file in (folder / "depth_left").iterdir():
            file.unlink()
        (folder / "depth_left").rmdir()
        assert open_dataset(folder).camera.is_stereo

    def test_bad(self, tmp_path: Path) -> None:
        folder = _tartanair(tmp_path / "P001")
        (folder / "pose_left.txt").write_text("1 2 3 0 0 0 1\n")
        with pytest.raises(TrajectoryError, match="of 2 frames, got 1x7 numbers"):
            _ = open_dataset(folder).ground_truth
        np.save(folder / "depth_left" / "000000_left_depth.npy", np.zeros((480, 640), int))
        with pytest.raises(DatasetError, match=r"depth\.npy: expected \(height, width\) floats"):
            open_dataset(folder)[0]
        (folder / "depth_left" / "000000_left_depth.npy").unlink()
        with pytest.raises(DatasetError, match="expected as many files as in image_left, 2, got 1"):
            open_dataset(folder)
