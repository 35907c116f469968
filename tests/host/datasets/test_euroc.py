"""Recordings in the layout of EuRoC: a rendered room through two lenses, tracked; and what is wrong with a folder."""

import shutil
from pathlib import Path

import numpy as np
import pytest
from raw_pairs import BASELINE_M, EUROC, FISHEYE, HEIGHT, RADTAN, T_BODY_LEFT, WIDTH, RawRoom, write_euroc

from jaxslam import Camera, Slam, TrackStatus, load_config
from jaxslam.datasets import Associated, open_dataset
from jaxslam.datasets.loaders.euroc import EurocDataset
from jaxslam.datasets.synthetic.virtual_camera import START_NS
from jaxslam.errors import CameraError, DatasetError, TrajectoryError
from jaxslam.geometry.se3 import compose
from jaxslam.sensors.stereo_rig import Lens
from jaxslam.trajectory.evaluation import evaluate
from jaxslam.trajectory.trajectory import read_euroc

FRAMES = 12
TINY = (Lens(64, 48, 42.0, 42.0, 31.0, 24.0, RADTAN[0].distortion), Lens(64, 48, 42.0, 42.0, 32.0, 23.0))
NOISE = """gyroscope_noise_density: 1.6968e-04
gyroscope_random_walk: 1.9393e-05
accelerometer_noise_density: 2.0e-3
accelerometer_random_walk: 3.0e-3
"""


@pytest.fixture(scope="module", params=[EUROC, FISHEYE], ids=["radtan", "equidistant"])
def flight(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_euroc(tmp_path_factory.mktemp("euroc") / "V1_01_easy", RawRoom(FRAMES, request.param))


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_euroc(tmp_path_factory.mktemp("tiny") / "V9", RawRoom(3, TINY))


@pytest.fixture
def tiny(tmp_path: Path, written: Path) -> Path:
    return Path(shutil.copytree(written, tmp_path / "V9"))


@pytest.mark.slow
class TestTracked:
    def test_every_pair_to_millimeters(self, flight: Path) -> None:
        """Rotation counts too: poses are of the rectified left camera, not of the body nor of the raw one."""
        dataset = open_dataset(flight)
        assert (dataset.name, len(dataset), dataset.camera.fps) == ("V1_01_easy", FRAMES, 20)
        assert dataset.camera.baseline_m == pytest.approx(BASELINE_M)
        frame = dataset[0]
        assert frame.size in ((WIDTH, HEIGHT), (EUROC[0].width, EUROC[0].height))
        assert frame.image.ndim == 2
        with Slam(dataset.camera, load_config("default", overrides=["semantics.model=null"])) as slam:
            records = slam.run(dataset)
            estimate = slam.trajectory
        assert [record.status for record in records[1:]] == [TrackStatus.OK] * (FRAMES - 1)
        assert dataset.ground_truth is not None
        figures = evaluate(estimate, dataset.ground_truth)
        assert figures.ate_rmse_m < 0.003
        assert figures.rpe_rot_deg_per_frame is not None
        assert figures.rpe_rot_deg_per_frame < 0.02


class TestFolder:
    def test_either_level(self, tiny: Path) -> None:
        outer, inner = open_dataset(tiny), open_dataset(tiny / "mav0")
        assert outer.name == inner.name == "V9"
        np.testing.assert_array_equal(outer.timestamps_ns, inner.timestamps_ns)
        np.testing.assert_array_equal(outer[1].image, inner[1].image)

    def test_pairs_of_one_time_only(self, tiny: Path) -> None:
        path = tiny / "mav0" / "cam1" / "data.csv"
        lines = path.read_text().splitlines()
        path.write_text("\n".join([lines[0], lines[2], lines[3], "1700000000000000000,1.png"]))
        dataset = open_dataset(tiny)
        assert isinstance(dataset, Associated)
        assert (len(dataset), dataset.unmatched) == (2, (1, 1))

    def test_no_ground_truth(self, tiny: Path) -> None:
        (tiny / "mav0" / "state_groundtruth_estimate0" / "data.csv").unlink()
        assert open_dataset(tiny).ground_truth is None

    def test_camera_of_the_user(self, tiny: Path) -> None:
        """A rectified one: images and poses stay as they are."""
        camera = Camera("mine", 64, 48, 40.0, 40.0, 31.5, 23.5, baseline_m=0.2)
        dataset = open_dataset(tiny, camera=camera)
        assert dataset.camera == camera
        assert (dataset[0].image != open_dataset(tiny)[0].image).any()
        with pytest.raises(CameraError, match="baseline_m: expected meters for a stereo pair"):
            open_dataset(tiny, camera="bonn")


def add_imu(recording: Path, T_BS: str = "[1, 0, 0, 0, 0, 0, 0]") -> Path:
    """An IMU at 200 Hz from 20 ms before the first frame; each row holds its number as the first rate."""
    folder = recording / "mav0" / "imu0"
    folder.mkdir()
    (folder / "sensor.yaml").write_text(f"sensor_type: imu\nT_BS: {T_BS}\nrate_hz: 200\n{NOISE}")
    rows = [f"{START_NS - 20_000_000 + 5_000_000 * row},{row},0,0,0,0,9.81" for row in range(40)]
    (folder / "data.csv").write_text("#timestamp [ns],w_RS_S_x [rad s^-1],...\n" + "\n".join(rows) + "\n")
    return folder


class TestImu:
    def test_frames_have_the_samples_since_the_last(self, tiny: Path) -> None:
        add_imu(tiny)
        dataset = open_dataset(tiny)
        assert isinstance(dataset, EurocDataset)
        assert dataset.imu_samples is not None
        assert len(dataset.imu_samples) == 40
        assert dataset.timestamps_ns[0] == START_NS
        rows = [frame.imu.gyro_rad_per_s[:, 0].tolist() for frame in dataset if frame.imu is not None]
        # Frames are 50 ms apart; before the first one there are 20 ms of samples.
        assert rows == [list(range(5)), list(range(5, 15)), list(range(15, 25))]
        last = dataset[-1].imu
        assert last is not None
        assert last.gyro_rad_per_s[0, 0] == 15

    def test_the_sheet_places_the_rectified_camera(self, tiny: Path) -> None:
        add_imu(tiny)
        dataset = open_dataset(tiny)
        assert isinstance(dataset, EurocDataset)
        assert dataset.imu is not None
        assert dataset.imu.rate_hz == 200
        truth, bodies = dataset.ground_truth, read_euroc(tiny / "mav0" / "state_groundtruth_estimate0" / "data.csv")
        assert truth is not None
        T_imu_cam = np.array(dataset.imu.T_imu_cam)
        np.testing.assert_allclose(compose(bodies.T_world_cam, T_imu_cam[None]), truth.T_world_cam, atol=1e-9)
        assert abs(T_imu_cam[:4] @ T_BODY_LEFT[:4]) < 1 - 1e-5  # rectification turns the camera

    def test_none_without_a_folder(self, tiny: Path) -> None:
        dataset = open_dataset(tiny)
        assert isinstance(dataset, EurocDataset)
        assert dataset.imu is dataset.imu_samples is dataset[0].imu is None

    @pytest.mark.parametrize(
        ("file", "change", "message"),
        [
            ("data.csv", (",3,0", ",three,0"), r"imu0/data\.csv:5: expected nanoseconds, three angular rates"),
            ("data.csv", ("\n1599", "\n1699"), r"imu0/data\.csv:6: expected a time after 1699"),
            ("sensor.yaml", ("rate_hz", "rate"), r"imu0/sensor\.yaml: missing 'rate_hz'"),
            ("sensor.yaml", ("T_BS", "T_SB"), r"imu0/sensor\.yaml: T_BS: expected a 4 x 4 matrix"),
        ],
    )
    def test_malformed(self, tiny: Path, file: str, change: tuple[str, str], message: str) -> None:
        path = add_imu(tiny) / file
        assert change[0] in path.read_text()
        path.write_text(path.read_text().replace(*change))
        with pytest.raises(DatasetError, match=message):
            open_dataset(tiny)

    @pytest.mark.parametrize("file", ["data.csv", "sensor.yaml"])
    def test_missing(self, tiny: Path, file: str) -> None:
        (add_imu(tiny) / file).unlink()
        with pytest.raises(DatasetError, match=rf"imu0/{file}: cannot be read"):
            open_dataset(tiny)


class TestBad:
    @pytest.mark.parametrize(
        ("file", "change", "error", "message"),
        [
            ("cam0/data.csv", ("png", "png,3"), DatasetError, "cam0/data.csv:2: expected `nanoseconds,file`"),
            ("cam0/data.csv", ("16000000", "16.0000"), DatasetError, "data.csv:2: expected `nanoseconds,file`"),
            ("cam1/data.csv", ("\n16", "\n17"), DatasetError, "cam1/data.csv: expected times of cam0, got 3 others"),
            ("cam0/data.csv", (".png", ".jpg"), DatasetError, "jpg: listed but missing, one of 3 such images"),
            ("cam0/sensor.yaml", ("T_BS", "T_SB"), CameraError, "cam0/sensor.yaml: T_BS: expected a 4 x 4 matrix"),
            ("cam0/sensor.yaml", ("[42.0", "[4"), CameraError, r"Lens\.fx|share too little|intrinsics"),
            ("cam1/sensor.yaml", ("radial-tangential", "fov"), CameraError, "distortion_model: expected one of"),
            ("cam1/sensor.yaml", ("[64, 48]", "[64, 50]"), CameraError, "right.height: expected the left one's 48"),
        ],
    )
    def test_text(self, tiny: Path, file: str, change: tuple[str, str], error: type[Exception], message: str) -> None:
        path = tiny / "mav0" / file
        assert change[0] in path.read_text()
        path.write_text(path.read_text().replace(*change))
        with pytest.raises(error, match=message):
            open_dataset(tiny)

    @pytest.mark.parametrize(
        ("text", "message"),
        [("1,0,0,0,1,0,0\n", "data.csv:1: expected"), ("1,0,0,0,2,0,0,0\n", "data.csv:1: the quaternion")],
    )
    def test_ground_truth(self, tiny: Path, text: str, message: str) -> None:
        (tiny / "mav0" / "state_groundtruth_estimate0" / "data.csv").write_text(text)
        with pytest.raises(TrajectoryError, match=message):
            _ = open_dataset(tiny).ground_truth

    def test_image_of_another_size(self, tiny: Path) -> None:
        dataset = open_dataset(tiny)
        image = sorted((tiny / "mav0" / "cam1" / "data").iterdir())[1]
        image.write_bytes((tiny.parent / "V9" / "mav0" / "cam0" / "data" / image.name).read_bytes()[:50])
        with pytest.raises(DatasetError, match=f"{image.name}: expected an image, got 50 bytes"):
            dataset[1]

    def test_rig_for_a_rectified_recording(self, tiny: Path, data_dir: Path) -> None:
        (tiny / "rig.yaml").write_text(
            "left: {width: 64, height: 48, fx: 42, fy: 42, cx: 31, cy: 24}\n"
            "right: {width: 64, height: 48, fx: 42, fy: 42, cx: 31, cy: 24}\nT_left_right: [1, 0, 0, 0, 0.1, 0, 0]\n"
        )
        assert open_dataset(tiny, camera=tiny / "rig.yaml").camera.baseline_m == pytest.approx(0.1)
        with pytest.raises(CameraError, match="expected one camera, as recordings of kind kitti are rectified, got"):
            open_dataset(data_dir / "kitti" / "sequences" / "06", camera=tiny / "rig.yaml")
