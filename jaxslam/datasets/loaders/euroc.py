"""Recordings in the layout of EuRoC MAV: `mav0/cam0`, `mav0/cam1`, stereo pairs before rectification, and `mav0/imu0`.

Source: Burri et al., "The EuRoC micro aerial vehicle datasets", IJRR 2016.
"""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from jaxslam.datasets.paired_images import ImagePairs, check_present, check_stereo, moved
from jaxslam.datasets.protocol import Fit, Loader, Unmatched
from jaxslam.errors import CameraError, ConfigError, DatasetError
from jaxslam.geometry.se3 import between, compose
from jaxslam.io.text_rows import text_rows
from jaxslam.io.yaml_files import read_mapping
from jaxslam.sensors.camera import Camera
from jaxslam.sensors.frame import Frame
from jaxslam.sensors.image_files import read_gray
from jaxslam.sensors.imu import ImuSamples, ImuSheet
from jaxslam.sensors.imu_files import read_imu_samples, read_imu_sheet
from jaxslam.sensors.rectification import RectifiedPair
from jaxslam.sensors.stereo_rig import Rig
from jaxslam.sensors.stereo_rig_formats import lens_of_kalibr, transform_of
from jaxslam.trajectory.trajectory import Trajectory, read_euroc

_CAMERAS, _IMU = ("cam0", "cam1"), "imu0"
_LIST, _SENSOR, _TRUTH = "data.csv", "sensor.yaml", Path("state_groundtruth_estimate0") / "data.csv"


class EurocDataset(ImagePairs):
    """A folder such as `MH_01_easy`, or the `mav0` in it; stereo pairs are rectified as they are decoded.

    A stereo pair is two images with exactly the same timestamp. EuRoC's ground truth is that of the body (the IMU);
    here it is converted to the rectified left camera, with `T_BS` of `cam0` and the rotation of rectification.

    Attributes:
        name: Name of the recording's folder.
        camera: The rectified left camera, with the baseline.
        timestamps_ns: `(n,)` int64 timestamps in nanoseconds, strictly increasing.
        unmatched: Number of images of the left and of the right camera without a partner.
        imu: Data sheet of `imu0`, with the place of `camera` on it; `None` without `imu0`.
        imu_samples: All samples of `imu0`, those between and around the frames; `None` without `imu0`.
    """

    def __init__(self, folder: Path, camera: Camera | RectifiedPair) -> None:
        """Match the images of the two lists; they are decoded on access.

        Raises:
            DatasetError: If a list is missing or malformed, a listed image is missing, nothing matches, or a file of
                `imu0` is missing or malformed.
            CameraError: If the camera is not a stereo pair, or `T_BS` of `cam0` is missing or malformed.
        """
        self._taken_with(camera)
        check_stereo(self.camera)
        self._root = _mav(folder)
        self.name = _name(self._root)
        left, right = (_listed(self._root / which) for which in _CAMERAS)
        common = sorted(left.keys() & right.keys())
        if not common:
            raise DatasetError(
                f"{self._root / _CAMERAS[1] / _LIST}: expected times of {_CAMERAS[0]}, got {len(right)} others"
            )
        self.timestamps_ns = np.array(common, np.int64)
        self.unmatched = Unmatched(len(left) - len(common), len(right) - len(common))
        self._files = [(left[stamp], right[stamp]) for stamp in common]
        check_present(images[stamp] for images in (left, right) for stamp in common)
        self._T_body_camera = _T_body_left(self._root)
        if self._pair is not None:
            self._T_body_camera = compose(self._T_body_camera, self._pair.T_left_camera)
        self.imu, self.imu_samples = _imu(self._root / _IMU, self._T_body_camera)

    def _frame(self, index: int, first: np.ndarray, second: np.ndarray) -> Frame:
        frame = super()._frame(index, first, second)
        if self.imu_samples is None:
            return frame
        index = range(len(self))[index]
        return replace(frame, imu=self.imu_samples.since_last_frame(self.timestamps_ns, index, self.camera.fps))

    def _truth(self) -> Trajectory | None:
        path = self._root / _TRUTH
        return moved(read_euroc(path), self._T_body_camera) if path.is_file() else None

    @property
    def _readers(self) -> tuple[Callable[[Path], np.ndarray], Callable[[Path], np.ndarray]]:
        return read_gray, read_gray


def _mav(folder: Path) -> Path:
    return folder / "mav0" if (folder / "mav0").is_dir() else folder


def _name(mav: Path) -> str:
    return mav.parent.name if mav.name == "mav0" else mav.name


def _imu(folder: Path, T_body_camera: np.ndarray) -> tuple[ImuSheet, ImuSamples] | tuple[None, None]:
    """Return the data sheet and the samples of an IMU, if its folder is there."""
    if not folder.is_dir():
        return None, None
    try:
        return read_imu_sheet(folder / _SENSOR, T_body_camera), read_imu_samples(folder / _LIST)
    except ConfigError as problem:
        raise DatasetError(str(problem)) from None


def _listed(folder: Path) -> dict[int, Path]:
    """Return the paths of one camera's images by timestamp in nanoseconds."""
    path = folder / _LIST
    found: dict[int, Path] = {}
    for number, row in text_rows(path, DatasetError, commas=True):
        if len(row) != 2 or not row[0].isdecimal():
            raise DatasetError(f"{path}:{number}: expected `nanoseconds,file`, got '{','.join(row)[:60]}'")
        stamp = int(row[0])
        if stamp in found:
            raise DatasetError(f"{path}:{number}: expected each time once, got {stamp} again")
        found[stamp] = folder / "data" / row[1]
    if not found:
        raise DatasetError(f"{path}: expected at least one line `nanoseconds,file`, got none")
    return found


def _T_body_left(mav: Path) -> np.ndarray:
    return _T_body(*_sensor(mav, _CAMERAS[0]))


def _T_body(raw: dict[str, Any], path: Path) -> np.ndarray:
    return transform_of(raw.get("T_BS"), f"{path}: T_BS")


def _sensor(mav: Path, which: str) -> tuple[dict[str, Any], Path]:
    path = mav / which / _SENSOR
    return read_mapping(path, CameraError), path


def _camera(folder: Path) -> RectifiedPair:
    """Return the rectified pair of `cam0/sensor.yaml` and `cam1/sensor.yaml`.

    Raises:
        CameraError: If a file is missing or malformed, or the two cameras do not form a stereo pair.
    """
    mav = _mav(folder)
    (left, left_path), (right, right_path) = (_sensor(mav, which) for which in _CAMERAS)
    T_left_right = between(_T_body(left, left_path), _T_body(right, right_path))
    try:
        lenses = [lens_of_kalibr(raw, f"{path}: ") for raw, path in ((left, left_path), (right, right_path))]
        rig = Rig(_name(mav), lenses[0], lenses[1], tuple(T_left_right.tolist()))
    except CameraError as error:
        raise CameraError(f"{mav}: {error}") from None
    rate = left.get("rate_hz")
    return RectifiedPair(replace(rig, fps=rate) if rate is not None else rig)


def _fit(folder: Path) -> Fit:
    mav = _mav(folder)
    there = all((mav / which / _LIST).is_file() for which in _CAMERAS)
    return Fit.LAYOUT if there else Fit.NO


LOADER = Loader(
    "euroc",
    _fit,
    _camera,
    EurocDataset,
    rectifies=True,
    files="mav0/cam0 and mav0/cam1",
    parts=tuple(f"mav0/{which}/{_LIST}" for which in _CAMERAS),
    reads_calibration=True,
)
