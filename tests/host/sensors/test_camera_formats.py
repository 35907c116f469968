"""Cameras: known ones, jaxslam's files, ORB-SLAM2's and ORB-SLAM3's, and what is refused."""

import dataclasses
from pathlib import Path

import jax
import jax.numpy as jnp
import pytest
from camera_texts import ORB_SLAM2

from jaxslam.errors import CameraError
from jaxslam.sensors.camera import Camera, known_cameras
from jaxslam.sensors.camera_formats import NEEDED

CAMERA = Camera("mine", 640, 480, 525.0, 524.0, 319.5, 239.5)

OWN = """\
width: 640
height: 480
fx: 5.25e2
fy: 524
cx: 319.5
cy: 239.5
distortion: [0.1, -0.2, 1e-3, 0, 0]
depth_scale_per_m: 1000
"""


ORB_SLAM3 = """\
%YAML:1.0
---
File.version: "1.0"
Camera.type: "PinHole"
Camera1.fx: 517.306408
Camera1.fy: 516.469215
Camera1.cx: 318.643040
Camera1.cy: 255.313989
Camera1.k1: 0.262383
Camera1.k2: -0.953104
Camera1.p1: -0.005358
Camera1.p2: 0.002628
Camera1.k3: 1.163314
Camera.width: 640
Camera.height: 480
Camera.fps: 30
Camera.RGB: 0
Stereo.ThDepth: 40.0
Stereo.b: 0.07732
RGBD.DepthMapFactor: 5000.0
Stereo.T_c1_c2: !!opencv-matrix
   rows: 4
   cols: 4
   dt: f
   data: [1, 0, 0, 0.1, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]
System.SaveAtlasToFile: "somewhere"
"""


def load(tmp_path: Path, text: str) -> Camera:
    path = tmp_path / "some_camera.yaml"
    path.write_text(text)
    return Camera.load(path)


class TestKnown:
    @pytest.mark.parametrize(
        ("name", "pinhole", "distortion"),
        [
            (
                "tum_fr1",
                (517.306408, 516.469215, 318.643040, 255.313989),
                (0.262383, -0.953104, -0.005358, 0.002628, 1.163314),
            ),
            (
                "tum_fr2",
                (520.908620, 521.007327, 325.141442, 249.701764),
                (0.231222, -0.784899, -0.003257, -0.000105, 0.917205),
            ),
            ("tum_fr3", (535.4, 539.2, 320.1, 247.6), (0.0,) * 5),
            (
                "bonn",
                (542.822841, 542.576870, 315.593520, 237.756098),
                (0.039903, -0.099343, -0.000730, -0.000144, 0.0),
            ),
        ],
    )
    def test_figures(self, name: str, pinhole: tuple[float, ...], distortion: tuple[float, ...]) -> None:
        camera = Camera.load(name)
        assert (camera.fx, camera.fy, camera.cx, camera.cy) == pinhole
        assert camera.distortion == distortion
        assert (camera.width, camera.height, camera.fps, camera.depth_scale_per_m) == (640, 480, 30.0, 5000.0)
        assert camera.name == name

    def test_list(self) -> None:
        assert known_cameras() == ["bonn", "tum_fr1", "tum_fr2", "tum_fr3"]

    def test_misspelt_name(self) -> None:
        with pytest.raises(CameraError, match=r"got 'tum_fr11' \(did you mean 'tum_fr1'\?\)"):
            Camera.load("tum_fr11")


class TestOwnFormat:
    def test_loads(self, tmp_path: Path) -> None:
        camera = load(tmp_path, OWN)
        assert camera == Camera(
            "some_camera", 640, 480, 525.0, 524.0, 319.5, 239.5, (0.1, -0.2, 0.001, 0.0, 0.0), 1000.0
        )

    @pytest.mark.parametrize(
        "camera",
        [
            CAMERA,
            dataclasses.replace(CAMERA, name='it\'s "ours"\\ ä: #1', distortion=(1e-7, -2e-5, 0, 0, 1.163314)),
            dataclasses.replace(CAMERA, baseline_m=0.12, far_depth_m=4.2, fps=7.5, color_order="bgr"),
        ],
        ids=["plain", "odd", "full"],
    )
    def test_save_and_load(self, tmp_path: Path, camera: Camera) -> None:
        camera.save(tmp_path / "saved.yaml")
        assert Camera.load(tmp_path / "saved.yaml") == camera

    def test_save_into_nowhere(self, tmp_path: Path) -> None:
        with pytest.raises(CameraError, match="cannot be written"):
            CAMERA.save(tmp_path / "missing" / "camera.yaml")

    def test_unknown_key(self, tmp_path: Path) -> None:
        with pytest.raises(CameraError, match=r"unknown key 'depth_scale' \(did you mean 'depth_scale_per_m'\?\)"):
            load(tmp_path, OWN.replace("depth_scale_per_m", "depth_scale"))

    @pytest.mark.parametrize("key", NEEDED)
    def test_missing_key(self, tmp_path: Path, key: str) -> None:
        text = "\n".join(line for line in OWN.splitlines() if not line.startswith(key))
        with pytest.raises(CameraError, match=rf"some_camera.yaml: missing '{key}'"):
            load(tmp_path, text)

    def test_needed_keys_are_the_fields_without_default(self) -> None:
        fields = dataclasses.fields(Camera)
        assert [f.name for f in fields if f.default is dataclasses.MISSING] == ["name", *NEEDED]


class TestOrbSlam2:
    def test_loads(self, tmp_path: Path) -> None:
        camera, known = load(tmp_path, ORB_SLAM2), Camera.load("tum_fr1")
        baseline = 40.0 / 517.306408
        assert camera == dataclasses.replace(
            known, name="some_camera", baseline_m=baseline, far_depth_m=40 * baseline, readout_s=0.0
        )

    @pytest.mark.parametrize("key", ["Camera.fx", "Camera.cy", "Camera.width"])
    def test_missing_key(self, tmp_path: Path, key: str) -> None:
        with pytest.raises(CameraError, match=f"missing '{key}'"):
            load(tmp_path, ORB_SLAM2.replace(f"{key}:", "Camera.other:"))

    def test_factor_of_zero_means_meters(self, tmp_path: Path) -> None:
        assert load(tmp_path, ORB_SLAM2.replace("5000.0", "0")).depth_scale_per_m == 1.0

    def test_stereo_without_depth_images(self, tmp_path: Path) -> None:
        text = ORB_SLAM2.replace("DepthMapFactor", "Other.factor").replace("Camera.k3", "Other.k3")
        camera = load(tmp_path, text)
        assert camera.depth_scale_per_m is None
        assert camera.distortion[4] == 0.0

    def test_threshold_without_baseline_means_nothing(self, tmp_path: Path) -> None:
        camera = load(tmp_path, ORB_SLAM2.replace("Camera.bf", "Other.bf"))
        assert (camera.baseline_m, camera.far_depth_m) == (None, None)

    @pytest.mark.parametrize("value", ["wide", "-40.0", "true"])
    def test_bad_baseline(self, tmp_path: Path, value: str) -> None:
        with pytest.raises(CameraError, match=r"Camera\.bf: expected a number > 0, got"):
            load(tmp_path, ORB_SLAM2.replace("bf: 40.0", f"bf: {value}"))


class TestOrbSlam3:
    def test_loads(self, tmp_path: Path) -> None:
        camera, known = load(tmp_path, ORB_SLAM3), Camera.load("tum_fr1")
        assert camera == dataclasses.replace(
            known, name="some_camera", baseline_m=0.07732, far_depth_m=40 * 0.07732, color_order="bgr", readout_s=0.0
        )

    def test_missing_key(self, tmp_path: Path) -> None:
        with pytest.raises(CameraError, match=r"missing 'Camera1\.fy', 'Camera1\.cx'"):
            load(tmp_path, ORB_SLAM3.replace("Camera1.fy", "Camera1.ff").replace("Camera1.cx", "Camera1.cc"))

    def test_fisheye(self, tmp_path: Path) -> None:
        with pytest.raises(CameraError, match=r"Camera\.type: expected 'PinHole' or 'Rectified', got 'Kann"):
            load(tmp_path, ORB_SLAM3.replace("PinHole", "KannalaBrandt8"))


class TestUnreadable:
    def test_missing_file(self, tmp_path: Path) -> None:
        with pytest.raises(CameraError, match="expected a known name or a YAML file"):
            Camera.load(tmp_path / "none.yaml")

    @pytest.mark.parametrize(
        ("text", "words"),
        [
            ("width: [640", "some_camera.yaml:1: not readable as YAML"),
            (OWN + "fx: 3\n", "some_camera.yaml:9: not readable as YAML: 'fx' stands twice"),
            ("- 640\n- 480\n", "expected `key: value` lines, got [640, 480]"),
            ("", "missing 'width', 'height'"),
            ("fx: !!python/object:os.system ls\n", "not readable as YAML"),
            ("fx: \0\n", "not readable as YAML"),
        ],
        ids=["cut", "twice", "list", "empty", "python", "control"],
    )
    def test_bad_text(self, tmp_path: Path, text: str, words: str) -> None:
        with pytest.raises(CameraError) as error:
            load(tmp_path, text)
        assert words in str(error.value)
        assert "\n" not in str(error.value)

    def test_no_text(self, tmp_path: Path) -> None:
        (tmp_path / "image.yaml").write_bytes(b"\x89PNG\xff\xfe\x00")
        with pytest.raises(CameraError, match="expected a text file in UTF-8"):
            Camera.load(tmp_path / "image.yaml")

    def test_bad_value_names_file_and_field(self, tmp_path: Path) -> None:
        with pytest.raises(CameraError, match=r"some_camera.yaml: fy: expected a finite number > 0, got 'far'"):
            load(tmp_path, OWN.replace("524", "far"))


class TestPlausible:
    @pytest.mark.parametrize(
        ("field", "value", "words"),
        [
            ("width", 640.0, "expected an integer >= 8 and <= 32768, got 640.0"),
            ("height", 0, "expected an integer >= 8"),
            ("fx", -525.0, "expected a finite number > 0, got -525.0"),
            ("fx", float("nan"), "expected a finite number"),
            ("fx", 0.82, "relative to the width?"),
            ("fy", 1e6, "expected pixels that suit an image of 480"),
            ("cx", 640.5, "expected a pixel inside the image, 0 to 640, got 640.5"),
            ("cy", -1.0, "expected a pixel inside the image"),
            ("distortion", (0.0, 0.0), "expected a list of 5"),
            ("distortion", (0.0, 0.0, 0.0, 0.0, float("inf")), "expected a list of 5"),
            ("depth_scale_per_m", 0, "expected a finite number > 0 or null, got 0"),
            ("fps", 0, "expected a finite number > 0"),
            ("baseline_m", 500.0, "in meters, at most 10, got 500 (millimeters?)"),
            ("color_order", "rbg", "expected one of 'rgb', 'bgr', got 'rbg'"),
            ("name", 3, "expected text, got 3"),
        ],
    )
    def test_refuses(self, field: str, value: object, words: str) -> None:
        with pytest.raises(CameraError) as error:
            dataclasses.replace(CAMERA, **{field: value})
        assert str(error.value).startswith(f"Camera.{field}: ")
        assert words in str(error.value)


def test_intrinsics() -> None:
    camera = Camera.load("tum_fr1")
    intrinsics = camera.intrinsics()
    assert all(leaf.dtype == jnp.float32 for leaf in jax.tree.leaves(intrinsics))
    assert intrinsics.distortion is not None
    assert intrinsics.distortion.shape == (5,)
    with jax.enable_x64(True):
        exact = camera.intrinsics(jnp.float64)
        assert [float(x) for x in exact[:4]] == [camera.fx, camera.fy, camera.cx, camera.cy]
        assert exact.distortion is not None
        assert tuple(map(float, exact.distortion)) == camera.distortion
