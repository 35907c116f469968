"""Stereo recordings in the layouts of EuRoC and KITTI: what is read back equals what was rendered."""

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from jaxslam.datasets import open_dataset
from jaxslam.datasets.loaders.euroc import EurocDataset
from jaxslam.datasets.synthetic import SyntheticConfig, SyntheticDataset, write_euroc, write_kitti
from jaxslam.datasets.synthetic.write_recording import write_recording
from jaxslam.errors import DatasetError
from jaxslam.geometry.se3 import compose
from jaxslam.sensors.frame import to_gray
from jaxslam.sensors.imu import ImuStates
from jaxslam.worlds import World, WorldRecording
from jaxslam.worlds.description import Room, Thing, Way, WorldCamera, WorldImu

FRAMES = 4
WAY = Way(((-1.5, 0.0, 1.4), (-1.2, 0.5, 1.4)), speed_m_per_s=0.3, look=(1.0, 0.0, 0.8))
WORLD = World(
    "A room.",
    FRAMES / 20,
    WAY,
    rooms=(Room((5.0, 4.0, 2.5)),),
    things=(Thing("chair", (0.6, -0.6)),),
    camera=WorldCamera(160, 120, fps=20.0, fx=140.0, baseline_m=0.11),
    imu=WorldImu(),
)


@pytest.fixture(scope="module")
def flight() -> WorldRecording:
    return WorldRecording(WORLD)


@pytest.fixture(scope="module")
def euroc(flight: WorldRecording, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("euroc") / "flight"
    write_euroc(flight, folder, texts={"labels.txt": flight.labels_text()})
    return folder


@pytest.fixture(scope="module")
def drive() -> SyntheticDataset:
    return SyntheticDataset(SyntheticConfig(width=160, height=120, frames=FRAMES, people=1, baseline_m=0.4))


@pytest.fixture(scope="module")
def kitti(drive: SyntheticDataset, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("kitti") / "drive"
    write_kitti(drive, folder, texts={"labels.txt": "# none\n"})
    return folder


def same_poses(got: np.ndarray, expected: np.ndarray) -> None:
    np.testing.assert_allclose(got[:, 4:], expected[:, 4:], atol=1e-6)
    np.testing.assert_allclose(np.abs(np.sum(got[:, :4] * expected[:, :4], axis=1)), 1, atol=1e-12)


class TestEuroc:
    def test_images_come_back_through_rectification(self, flight: WorldRecording, euroc: Path) -> None:
        """Without distortion and with aligned axes it is the identity."""
        read = open_dataset(euroc)
        assert len(read) == FRAMES
        np.testing.assert_array_equal(read.timestamps_ns, flight.timestamps_ns)
        for index in range(FRAMES):
            got, expected = read[index], flight.render(index)
            assert got.right is not None
            assert expected.right is not None
            np.testing.assert_array_equal(got.image, to_gray(expected.rgb))
            np.testing.assert_array_equal(got.right, to_gray(expected.right))

    def test_the_camera_comes_back(self, flight: WorldRecording, euroc: Path) -> None:
        got, expected = open_dataset(euroc).camera, flight.camera
        for name in ("fx", "fy", "cx", "cy", "baseline_m"):
            assert getattr(got, name) == pytest.approx(getattr(expected, name), abs=1e-9)
        assert (got.width, got.height, got.fps) == (160, 120, 20.0)

    def test_poses_are_those_of_the_camera(self, flight: WorldRecording, euroc: Path) -> None:
        truth = open_dataset(euroc).ground_truth
        assert truth is not None
        np.testing.assert_array_equal(truth.timestamps_ns, flight.timestamps_ns)
        same_poses(truth.T_world_cam, flight.ground_truth.T_world_cam)

    def test_the_imu_comes_back(self, flight: WorldRecording, euroc: Path) -> None:
        read = open_dataset(euroc)
        assert isinstance(read, EurocDataset)
        got, expected = read.imu_samples, flight.imu_samples
        assert got is not None
        assert expected is not None
        np.testing.assert_array_equal(got.timestamps_ns, expected.timestamps_ns)
        np.testing.assert_allclose(got.gyro_rad_per_s, expected.gyro_rad_per_s, atol=5.1e-13)
        np.testing.assert_allclose(got.accel_m_per_s2, expected.accel_m_per_s2, atol=5.1e-13)
        assert read.imu is not None
        assert flight.imu is not None
        np.testing.assert_allclose(read.imu.T_imu_cam, flight.imu.T_imu_cam, atol=1e-9)
        figures = ("rate_hz", "gyroscope_noise_density", "accelerometer_random_walk")
        assert all(getattr(read.imu, name) == getattr(flight.imu, name) for name in figures)
        for index in range(FRAMES):
            of_read, of_rendered = read[index].imu, flight[index].imu
            assert of_read is not None
            assert of_rendered is not None
            np.testing.assert_array_equal(of_read.timestamps_ns, of_rendered.timestamps_ns)

    def test_states_are_in_the_order_of_the_format(self, flight: WorldRecording, euroc: Path) -> None:
        path = euroc / "mav0" / "state_groundtruth_estimate0" / "data.csv"
        heading = path.read_text().splitlines()[0].split(",")
        assert (heading[4], heading[8], heading[13]) == ("q_RS_w []", "v_RS_R_x [m s^-1]", "b_w_RS_S_z [rad s^-1]")
        table, states = np.loadtxt(path, delimiter=","), flight.imu_states
        assert states is not None
        assert states.accel_bias_m_per_s2 is not None
        assert table.shape == (FRAMES, 17)
        np.testing.assert_allclose(table[:, 1:4], states.T_world_imu[:, 4:], atol=1e-11)
        np.testing.assert_allclose(table[:, 8:11], states.velocity_m_per_s, atol=1e-11)
        np.testing.assert_allclose(table[:, 14:], states.accel_bias_m_per_s2, atol=1e-11)
        assert states.accel_bias_m_per_s2[-1].any()

    def test_masks_have_the_names_of_the_images(self, flight: WorldRecording, euroc: Path) -> None:
        for kind in ("mask", "instance"):
            assert sorted(p.name for p in (euroc / kind).iterdir()) == [f"{t}.png" for t in flight.timestamps_ns]
        number = cv2.imread(str(euroc / "instance" / f"{flight.timestamps_ns[1]}.png"), cv2.IMREAD_UNCHANGED)
        np.testing.assert_array_equal(number, flight.render(1).instance_mask)
        assert "1 1 chair" in (euroc / "labels.txt").read_text()

    def test_unknown_biases_are_left_out(self, tmp_path: Path) -> None:
        recording = WorldRecording(WORLD)
        assert recording.imu_states is not None
        known = recording.imu_states
        recording.imu_states = ImuStates(known.timestamps_ns, known.T_world_imu, known.velocity_m_per_s)
        write_euroc(recording, tmp_path / "out")
        path = tmp_path / "out" / "mav0" / "state_groundtruth_estimate0" / "data.csv"
        assert np.loadtxt(path, delimiter=",").shape == (FRAMES, 11)
        assert open_dataset(tmp_path / "out").ground_truth is not None

    def test_without_an_imu_the_body_is_the_camera(self, drive: SyntheticDataset, tmp_path: Path) -> None:
        write_euroc(drive, tmp_path / "out")
        read = open_dataset(tmp_path / "out")
        assert isinstance(read, EurocDataset)
        assert read.imu is read[0].imu is None
        assert not (tmp_path / "out" / "mav0" / "imu0").exists()
        assert read.ground_truth is not None
        same_poses(read.ground_truth.T_world_cam, drive.T_world_cam)
        table = np.loadtxt(tmp_path / "out" / "mav0" / "state_groundtruth_estimate0" / "data.csv", delimiter=",")
        np.testing.assert_allclose(table[:, 1:4], drive.T_world_cam[:, 4:], atol=1e-11)


class TestKitti:
    def test_images_come_back(self, drive: SyntheticDataset, kitti: Path) -> None:
        read = open_dataset(kitti / "sequences" / "00")
        assert len(read) == FRAMES
        for index in range(FRAMES):
            got, expected = read[index], drive.render(index)
            assert got.right is not None
            assert expected.right is not None
            np.testing.assert_array_equal(got.image, expected.rgb)
            np.testing.assert_array_equal(got.right, expected.right)

    def test_times_begin_with_zero(self, drive: SyntheticDataset, kitti: Path) -> None:
        since_ns = drive.timestamps_ns - drive.timestamps_ns[0]
        np.testing.assert_array_equal(open_dataset(kitti / "sequences" / "00").timestamps_ns, since_ns)

    def test_the_camera_comes_back_by_file_and_by_calibration(self, drive: SyntheticDataset, kitti: Path) -> None:
        folder = kitti / "sequences" / "00"
        assert open_dataset(folder).camera == drive.camera
        (folder / "camera.yaml").rename(folder / "camera.txt")
        got = open_dataset(folder).camera
        (folder / "camera.txt").rename(folder / "camera.yaml")
        for name in ("width", "height", "fx", "fy", "cx", "cy", "baseline_m"):
            assert getattr(got, name) == pytest.approx(getattr(drive.camera, name), abs=1e-9)

    def test_poses_are_those_of_the_camera(self, drive: SyntheticDataset, kitti: Path) -> None:
        truth = open_dataset(kitti / "sequences" / "00").ground_truth
        assert truth is not None
        same_poses(truth.T_world_cam, drive.T_world_cam)

    def test_masks_and_texts_lie_in_the_sequence(self, drive: SyntheticDataset, kitti: Path) -> None:
        folder = kitti / "sequences" / "00"
        mask = cv2.imread(str(folder / "mask" / "000003.png"), cv2.IMREAD_UNCHANGED)
        np.testing.assert_array_equal(mask, drive.render(3).instance_mask)
        assert (folder / "labels.txt").read_text() == "# none\n"


@pytest.mark.parametrize("write", [write_euroc, write_kitti])
class TestFolders:
    def test_a_depth_camera_is_refused(self, write: Callable[..., None], tmp_path: Path) -> None:
        depth = SyntheticDataset(SyntheticConfig(width=64, height=48, frames=1))
        with pytest.raises(DatasetError, match=r"expected a stereo pair \(baseline_m\), got a camera with depth"):
            write(depth, tmp_path / "out")
        assert not list(tmp_path.iterdir())

    def test_a_folder_in_use_is_kept(self, write: Callable[..., None], drive: SyntheticDataset, tmp_path: Path) -> None:
        (tmp_path / "precious.txt").write_text("mine")
        with pytest.raises(DatasetError, match="expected no such folder or an empty one"):
            write(drive, tmp_path)
        assert [path.name for path in tmp_path.iterdir()] == ["precious.txt"]

    def test_an_interrupted_write_leaves_no_recording(
        self, write: Callable[..., None], drive: SyntheticDataset, tmp_path: Path
    ) -> None:
        calls = []

        def stop(done: int, total: int) -> None:
            calls.append((done, total))
            if done == 2:
                raise KeyboardInterrupt

        with pytest.raises(KeyboardInterrupt):
            write(drive, tmp_path / "out", stop)
        assert calls == [(1, FRAMES), (2, FRAMES)]
        assert [path.name for path in tmp_path.iterdir()] == ["out.partial"]
        write(drive, tmp_path / "out")
        assert [path.name for path in tmp_path.iterdir()] == ["out"]

    def test_an_unwritable_place_is_named(
        self, write: Callable[..., None], drive: SyntheticDataset, tmp_path: Path
    ) -> None:
        (tmp_path / "file").write_text("")
        with pytest.raises(DatasetError, match=r"file.*cannot be written"):
            write(drive, tmp_path / "file" / "out")


class TestLayouts:
    @pytest.mark.parametrize(
        ("baseline_m", "layout", "file"),
        [
            (None, None, "rgb.txt"),
            (0.1, None, "sequences/00/calib.txt"),
            (0.1, "euroc", "mav0/cam1/sensor.yaml"),
            (0.1, "kitti", "poses/00.txt"),
        ],
    )
    def test_follow_the_camera(self, tmp_path: Path, baseline_m: float | None, layout: str | None, file: str) -> None:
        config = SyntheticConfig(width=64, height=48, frames=1, baseline_m=baseline_m)
        to_open = write_recording(SyntheticDataset(config), tmp_path / "out", layout)  # type: ignore[arg-type]
        assert (tmp_path / "out" / file).is_file()
        assert len(open_dataset(to_open)) == 1

    def test_an_imu_asks_for_euroc(self, flight: WorldRecording, tmp_path: Path) -> None:
        to_open = write_recording(flight, tmp_path / "out")
        assert (to_open / "mav0" / "imu0" / "data.csv").is_file()

    def test_a_pair_is_refused_by_tum(self, drive: SyntheticDataset, tmp_path: Path) -> None:
        with pytest.raises(DatasetError, match="expected a camera with depth images, got a stereo pair"):
            write_recording(drive, tmp_path / "out", "tum")


def test_the_body_of_euroc_is_where_the_imu_is(flight: WorldRecording) -> None:
    states, sheet = flight.imu_states, flight.imu
    assert states is not None
    assert sheet is not None
    same_poses(compose(states.T_world_imu, np.array(sheet.T_imu_cam)[None]), flight.ground_truth.T_world_cam)
