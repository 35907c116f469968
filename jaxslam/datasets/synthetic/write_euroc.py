"""Write a rendered stereo recording to disk in the layout of EuRoC MAV, with its IMU if it has one.

Source: Burri et al., "The EuRoC micro aerial vehicle datasets", IJRR 2016.
"""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from jaxslam.datasets.synthetic.recording_folder import (
    Progress,
    RenderedFrame,
    RenderedRecording,
    both_sides,
    check_is_pair,
    filling,
    imu_of,
    write_frames,
    write_texts,
)
from jaxslam.geometry.se3 import IDENTITY, compose
from jaxslam.sensors.camera import Camera
from jaxslam.sensors.frame import to_gray
from jaxslam.sensors.imu_files import sensor_pose_lines, write_imu_samples, write_imu_sheet

_CAMERAS, _IMU, _TRUTH = ("cam0", "cam1"), "imu0", "state_groundtruth_estimate0"
_STATE = (
    ("p_RS_R", "xyz", "m"),
    ("q_RS", "wxyz", ""),
    ("v_RS_R", "xyz", "m s^-1"),
    ("b_w_RS_S", "xyz", "rad s^-1"),
    ("b_a_RS_S", "xyz", "m s^-2"),
)


def write_euroc(
    dataset: RenderedRecording,
    folder: str | Path,
    progress: Progress | None = None,
    texts: Mapping[str, str] | None = None,
) -> None:
    """Write a stereo recording that `open_dataset` reads: the files of EuRoC MAV, and masks.

    In `mav0/` there are `cam0/` and `cam1/` with gray images, without distortion; `imu0/` if the recording has an IMU;
    and `state_groundtruth_estimate0/` with what is known of the body at the times of the frames: its pose, with an IMU
    its velocity, and the biases if they are known. The body is the IMU; without one, it is the left camera. Beside
    `mav0/` there are folders of masks with the names of the images (`mask/` with the numbers of what moves).

    Frames are written to `<folder>.partial`, as `write_tum` does.

    Args:
        dataset: Recording of a stereo pair.
        folder: Folder to write to; it must not exist, or be empty.
        progress: Called after each frame with the number of frames written and to be written.
        texts: Contents of text files to write beside `mav0`, by name.

    Raises:
        DatasetError: The folder is in use, a file cannot be written, or the recording is not of a stereo pair.
    """
    check_is_pair(dataset)
    with filling(folder) as partial:
        write_frames(dataset, lambda _, frame: _images(partial, frame), progress)
        _write_sensors(partial / "mav0", dataset)
        write_texts(partial, texts)


def _images(folder: Path, frame: RenderedFrame) -> dict[Path, np.ndarray]:
    """Return the images of a frame by path."""
    name = f"{frame.timestamp_ns}.png"
    sides = zip(_CAMERAS, both_sides(frame), strict=True)
    images = {folder / "mav0" / which / "data" / name: to_gray(image) for which, image in sides}
    return images | {folder / kind / name: image for kind, image in frame.mask_images.items()}


def _write_sensors(mav: Path, dataset: RenderedRecording) -> None:
    """Write everything in `mav0` but the images."""
    imu = imu_of(dataset)
    if imu is None:
        _write_cameras(mav, dataset, IDENTITY)
        truth = dataset.ground_truth
        _write_states(mav / _TRUTH, truth.timestamps_ns, _columns(truth.T_world_cam))
        return
    _write_cameras(mav, dataset, np.array(imu.sheet.T_imu_cam))
    (mav / _IMU).mkdir()
    write_imu_sheet(mav / _IMU / "sensor.yaml", imu.sheet)
    write_imu_samples(mav / _IMU / "data.csv", imu.samples)
    states = imu.states
    biases = states.gyro_bias_rad_per_s, states.accel_bias_m_per_s2
    columns = [*_columns(states.T_world_imu), states.velocity_m_per_s, *(bias for bias in biases if bias is not None)]
    _write_states(mav / _TRUTH, states.timestamps_ns, columns)


def _write_cameras(mav: Path, dataset: RenderedRecording, T_body_left: np.ndarray) -> None:
    """Write the lists and the sensor files of both cameras, the left one at `T_body_left`, `(7,)` wxyz_xyz."""
    baseline_m = dataset.camera.baseline_m or 0.0
    T_body_right = compose(T_body_left, np.array([1.0, 0, 0, 0, baseline_m, 0, 0]))
    rows = "".join(f"{stamp},{stamp}.png\n" for stamp in dataset.timestamps_ns.tolist())
    for which, T in zip(_CAMERAS, (T_body_left, T_body_right), strict=True):
        (mav / which / "data.csv").write_text(f"#timestamp [ns],filename\n{rows}", encoding="utf-8")
        (mav / which / "sensor.yaml").write_text(_sensor(dataset.camera, T), encoding="utf-8")


def _sensor(camera: Camera, T_body_camera: np.ndarray) -> str:
    """Return a sensor file of a camera."""
    lines = [
        "sensor_type: camera",
        *sensor_pose_lines(T_body_camera),
        f"rate_hz: {camera.fps!r}",
        f"resolution: [{camera.width}, {camera.height}]",
        "camera_model: pinhole",
        f"intrinsics: [{camera.fx!r}, {camera.fy!r}, {camera.cx!r}, {camera.cy!r}]",
        "distortion_model: radial-tangential",
        "distortion_coefficients: [0.0, 0.0, 0.0, 0.0]",
    ]
    return "\n".join(lines) + "\n"


def _columns(poses: np.ndarray) -> list[np.ndarray]:
    """Return the positions and the quaternions of `(n, 7)` poses."""
    return [poses[:, 4:], poses[:, :4]]


def _write_states(folder: Path, timestamps_ns: np.ndarray, columns: list[np.ndarray]) -> None:
    """Write the truth about the body: of `_STATE`, the quantities that are known, `(n, 3)` or `(n, 4)` each."""
    names = [f"{name}_{axis} [{unit}]" for (name, axes, unit), _ in zip(_STATE, columns, strict=False) for axis in axes]
    table = zip(timestamps_ns.tolist(), np.concatenate(columns, axis=1).tolist(), strict=True)
    rows = [",".join([str(stamp), *(f"{number:.12f}" for number in numbers)]) for stamp, numbers in table]
    folder.mkdir()
    (folder / "data.csv").write_text("\n".join([",".join(["#timestamp", *names]), *rows]) + "\n", encoding="utf-8")
