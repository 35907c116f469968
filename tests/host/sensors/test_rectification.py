"""Rectification: rows that match, depth that is right, files of calibrations, and what is no pair."""

import dataclasses
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from raw_pairs import BASELINE_M, FISHEYE, HEIGHT, RADTAN, WIDTH, RawRoom
from rig_texts import KALIBR, ORB_SLAM3, OWN

from jaxslam import Camera, RectifiedPair, Rig
from jaxslam.errors import CameraError, FrameError
from jaxslam.geometry.so3 import matrices
from jaxslam.sensors.rectification import load_camera
from jaxslam.sensors.stereo_rig import Lens
from jaxslam.sensors.stereo_rig_formats import read_rig


def _rig(**changes: Any) -> Rig:
    fields: dict[str, Any] = {
        "name": "rig",
        "left": RADTAN[0],
        "right": RADTAN[1],
        "T_left_right": (1, 0, 0, 0, 0.1, 0, 0),
    }
    return Rig(**fields | changes)


def _write(folder: Path, text: str) -> Path:
    path = folder / "rig.yaml"
    path.write_text(text)
    return path


class TestRectified:
    @pytest.mark.parametrize("lenses", [RADTAN, FISHEYE], ids=["radtan", "equidistant"])
    def test_points_lie_on_one_row_at_the_right_disparity(self, lenses: tuple[Lens, Lens]) -> None:
        """By the pixels' rays: a point of the world goes through each lens, its map, and back to the same row."""
        raw = RawRoom(frames=1, lenses=lenses)
        pair = RectifiedPair(raw.rig)
        X = np.random.default_rng(0).uniform((-1.0, -0.7, 2.0), (1.0, 0.7, 5.0), (60, 3))  # of the rectified camera
        T_left_right, R = np.array(raw.rig.T_left_right), matrices(pair.T_left_camera[:4])
        in_left = X @ R.T
        in_right = (in_left - T_left_right[4:]) @ matrices(T_left_right[:4])
        u = pair.camera.fx * X[:, 0] / X[:, 2] + pair.camera.cx
        v = pair.camera.fx * X[:, 1] / X[:, 2] + pair.camera.cy
        disparity = pair.camera.fx * BASELINE_M / X[:, 2]
        inside = (u > 60) & (u < WIDTH - 10) & (v > 10) & (v < HEIGHT - 10)
        assert inside.sum() > 30
        for lens, points, shift, side in zip(lenses, (in_left, in_right), (0 * u, disparity), (0, 1), strict=True):
            seen = _seen(points, lens)
            straight = _straightened(pair, side, seen)[inside]
            np.testing.assert_allclose(straight[:, 0], (u - shift)[inside], atol=0.55)
            np.testing.assert_allclose(straight[:, 1], v[inside], atol=0.55)
            assert np.abs(np.mean(straight[:, 1] - v[inside])) < 0.05

    def test_rows_of_images_match(self) -> None:
        """Before, features are rows apart; after, less than half a pixel, with nothing black at the edges."""
        raw = RawRoom(frames=1)
        images = raw.images(0)
        straight = RectifiedPair(raw.rig).images(*images)
        before, after = (_rows_apart(*pair) for pair in (images, straight))
        assert np.median(np.abs(before)) > 3
        assert np.median(np.abs(after)) < 0.2
        assert abs(np.median(after)) < 0.05
        assert min(image.max(axis=2).min() for image in straight) > 0

    def test_frame_has_the_camera_of_the_pair(self) -> None:
        pair = RectifiedPair(_rig(far_depth_baselines=40.0, fps=15.0))
        gray = np.full((HEIGHT, WIDTH), 90, np.uint8)
        frame = pair.of(17, gray, gray)
        assert frame.right is not None
        assert (frame.timestamp_ns, frame.size, frame.right.shape) == (17, (WIDTH, HEIGHT), gray.shape)
        camera = pair.camera
        assert (camera.is_stereo, camera.fps, camera.fx) == (True, 15, camera.fy)
        assert camera.baseline_m == pytest.approx(0.1)
        assert camera.far_depth_m == pytest.approx(4.0)
        assert not any(camera.distortion)

    def test_perfect_pair_stays_as_it_is(self) -> None:
        lens = Lens(WIDTH, HEIGHT, 400.0, 400.0, 319.5, 239.5)
        pair = RectifiedPair(_rig(left=lens, right=lens))
        image = np.random.default_rng(0).integers(0, 255, (HEIGHT, WIDTH), np.uint8)
        assert pair.camera.fx == pytest.approx(400, rel=0.01)
        np.testing.assert_allclose(pair.T_left_camera, [1, 0, 0, 0, 0, 0, 0], atol=1e-12)
        assert pair.images(image, image)[0].shape == image.shape


def _seen(points: np.ndarray, lens: Lens) -> np.ndarray:
    """`(n, 2)` pixels of points in the axes of a camera, through its lens."""
    zero = np.zeros((3, 1))
    if lens.model == "equidistant":
        return cv2.fisheye.projectPoints(points[:, None], zero, zero, lens.matrix, lens.terms)[0][:, 0]
    return cv2.projectPoints(points[:, None], zero, zero, lens.matrix, lens.terms)[0][:, 0]


def _straightened(pair: RectifiedPair, side: int, pixels: np.ndarray) -> np.ndarray:
    """Where raw pixels come to lie: pictures of their coordinates go through the maps, and the nearest is looked up."""
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    maps = pair._maps[side]
    x = cv2.remap(u.astype(np.float32), *maps, cv2.INTER_LINEAR)
    y = cv2.remap(v.astype(np.float32), *maps, cv2.INTER_LINEAR)
    found = []
    for px, py in pixels:
        index = int(np.argmin((x - px) ** 2 + (y - py) ** 2))
        row, column = divmod(index, WIDTH)
        found.append((column, row))
    return np.array(found, float)


def _rows_apart(left: np.ndarray, right: np.ndarray) -> np.ndarray:
    sift = cv2.SIFT.create(600)
    (a, of_a), (b, of_b) = (sift.detectAndCompute(image, None) for image in (left, right))
    pairs = [one for one, two in cv2.BFMatcher().knnMatch(of_a, of_b, k=2) if one.distance < 0.7 * two.distance]
    assert len(pairs) > 100
    return np.array([a[match.queryIdx].pt[1] - b[match.trainIdx].pt[1] for match in pairs])


class TestFiles:
    def test_orb_slam3(self, tmp_path: Path) -> None:
        rig = read_rig(_write(tmp_path, ORB_SLAM3))
        assert (rig.name, rig.fps, rig.left.model, rig.left.width) == ("rig", 20, "radtan", 752)
        assert rig.right.distortion == (-0.28368365, 0.07451284, -0.00010473, -3.555907e-05, 0.0)
        pair = RectifiedPair.load(tmp_path / "rig.yaml")
        assert pair.camera.baseline_m == pytest.approx(0.11007784)
        assert pair.camera.far_depth_m == pytest.approx(60 * 0.11007784)
        assert 350 < pair.camera.fx < 480
        assert isinstance(load_camera(tmp_path / "rig.yaml"), RectifiedPair)

    def test_orb_slam3_fisheye(self, tmp_path: Path) -> None:
        text = ORB_SLAM3.replace("PinHole", "KannalaBrandt8").replace(".p1:", ".k3:").replace(".p2:", ".k4:")
        rig = read_rig(_write(tmp_path, text))
        assert (rig.left.model, len(rig.left.distortion)) == ("equidistant", 4)

    def test_kalibr(self, tmp_path: Path) -> None:
        rig = read_rig(_write(tmp_path, KALIBR))
        assert (rig.left, rig.right.fx, rig.right.model) == (FISHEYE[0], 398, "equidistant")
        np.testing.assert_allclose(rig.T_left_right, [1, 0, 0, 0, 0.12, -0.001, 0], atol=1e-12)

    def test_own(self, tmp_path: Path) -> None:
        rig = read_rig(_write(tmp_path, OWN))
        assert (rig.left, rig.right.distortion) == (RADTAN[0], ())
        assert (rig.fps, rig.far_depth_baselines) == (15, 40)
        assert rig.T_left_right == (1, 0, 0, 0, 0.1, 0, 0)

    def test_one_camera_is_still_read(self) -> None:
        assert load_camera("bonn") == Camera.load("bonn")

    @pytest.mark.parametrize(
        ("text", "message"),
        [
            (ORB_SLAM3.replace("Camera2.fy: 456.134\n", ""), r"missing 'Camera2\.fy'"),
            (ORB_SLAM3.split("Stereo.T_c1_c2", maxsplit=1)[0], r"missing 'Stereo\.T_c1_c2'"),
            (ORB_SLAM3.replace("PinHole", "Rectified"), r"Camera\.type: expected one of PinHole, KannalaBrandt8"),
            (ORB_SLAM3.replace("0.9999972564", "0.5"), "expected a rotation, a translation and the row 0 0 0 1"),
            (OWN.replace("fps", "fsp"), r"unknown key 'fsp' \(did you mean 'fps'"),
            (OWN.replace("fx: 417.0, ", ""), "right: missing 'fx'"),
            (OWN.replace("cy: 235", "cy: 535"), r"right: Lens\.cy: expected a pixel inside the image"),
            (OWN.replace("-0.28, ", ""), r"left: Lens\.distortion: expected 4 or 5 numbers for radtan, got 3"),
            (OWN.replace("1, 0, 0, 0, 0.1", "1, 0, 0.1"), "T_left_right: expected a 4 x 4 matrix or qw qx qy qz x y z"),
            (OWN.replace("left: {", "left: 3 #"), "left: expected `key: value` lines, got 3"),
            (KALIBR.replace("pinhole", "omni"), "camera_model: expected 'pinhole', got 'omni'"),
            (KALIBR.replace("equidistant", "fov"), "distortion_model: expected one of"),
            (KALIBR.replace("[640, 480]", "[640]"), "resolution: expected 2 numbers"),
            (KALIBR.replace("T_cn_cnm1", "T_cam_imu"), "T_cn_cnm1: expected a 4 x 4 matrix, got none"),
        ],
    )
    def test_bad(self, tmp_path: Path, text: str, message: str) -> None:
        with pytest.raises(CameraError, match=message) as error:
            read_rig(_write(tmp_path, text))
        assert "rig.yaml" in str(error.value)

    def test_pair_where_one_camera_is_expected(self, tmp_path: Path) -> None:
        for text in (ORB_SLAM3, KALIBR, OWN):
            with pytest.raises(CameraError, match="expected one camera, got an unrectified pair"):
                Camera.load(_write(tmp_path, text))


class TestNoPair:
    @pytest.mark.parametrize(
        ("change", "message"),
        [
            ({"T_left_right": (1, 0, 0, 0, 0, 0, 0)}, "expected a baseline in meters, got 0 0 0"),
            ({"T_left_right": (1, 0, 0, 0, -0.1, 0, 0)}, "left and right swapped, or the transform the other way"),
            ({"T_left_right": (1, 0, 0, 0, 0.01, 0.1, 0)}, r"one above the other\?"),
            ({"T_left_right": (1, 0, 0, 0, 0.01, 0, 0.1)}, r"one behind the other\?"),
            ({"T_left_right": (0.5, 0, 0, 0, 0.1, 0, 0)}, "expected a unit quaternion first, got one of 0.5"),
            ({"right": FISHEYE[1]}, "right.model: expected the left one's radtan, got equidistant"),
            ({"right": dataclasses.replace(RADTAN[1], width=700)}, "right.width: expected the left one's 640, got 700"),
            ({"fps": 0}, r"Rig\.fps: expected"),
        ],
    )
    def test_rig(self, change: dict, message: str) -> None:
        with pytest.raises(CameraError, match=message):
            _rig(**change)

    def test_turned_away_from_each_other(self) -> None:
        """The right camera looks backwards."""
        with pytest.raises(CameraError, match="expected cameras that look the same way, got 180 degrees apart"):
            _rig(T_left_right=(0, 0, 1, 0, 0.1, 0, 0))

    def test_images(self) -> None:
        pair = RectifiedPair(_rig())
        gray = np.zeros((HEIGHT, WIDTH), np.uint8)
        with pytest.raises(FrameError, match="right: expected the 640x480 pixels of rig 'rig', got 480x640"):
            pair.of(0, gray, gray.T.copy())
        with pytest.raises(FrameError, match=r"left: expected .* uint8, got float64"):
            pair.of(0, gray.astype(float), gray)
        with pytest.raises(FrameError, match="right: expected the shape of the left image"):
            pair.of(0, gray, np.zeros((HEIGHT, WIDTH, 3), np.uint8))
