"""Recordings of the KITTI odometry benchmark: rectified stereo pairs, gray or in color, from a car.

Source: Geiger, Lenz and Urtasun, "Are we ready for Autonomous Driving? The KITTI Vision Benchmark Suite", CVPR 2012.
"""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxslam.datasets.paired_images import ImagePairs, check_stereo, moved
from jaxslam.datasets.protocol import Fit, Loader
from jaxslam.errors import CameraError, DatasetError, TrajectoryError
from jaxslam.sensors.camera import Camera
from jaxslam.sensors.image_files import read_color, read_gray
from jaxslam.trajectory.formats import read_times
from jaxslam.trajectory.trajectory import Trajectory, read_kitti

_CALIBRATION, _TIMES = "calib.txt", "times.txt"


class _Pair(NamedTuple):
    """The folders of one stereo camera.

    Attributes:
        left: Folder of the left images.
        right: Folder of the right images.
        projections: Names of the left and the right camera in the calibration file.
        gray: Whether the images are gray.
    """

    left: str
    right: str
    projections: tuple[str, str]
    gray: bool


_PAIRS = (_Pair("image_0", "image_1", ("P0", "P1"), True), _Pair("image_2", "image_3", ("P2", "P3"), False))
"""Gray comes first because it is sharper, and color is not needed."""


class KittiDataset(ImagePairs):
    """A folder such as `sequences/06`, with poses in `poses/06.txt` two folders up if they are public.

    The poses are converted to the left camera in use: KITTI's are those of the left gray camera, 6 cm from the left
    color camera.

    Attributes:
        name: The folder's name after `kitti_`.
        camera: The left camera, with the baseline.
        timestamps_ns: `(n,)` int64 nanoseconds from the start, strictly increasing.
    """

    def __init__(self, folder: Path, camera: Camera) -> None:
        """Find the images; they are decoded on access.

        Raises:
            DatasetError: If timestamps are missing or malformed, or do not match the images.
            CameraError: If the camera is not a stereo pair.
        """
        check_stereo(camera)
        self._sides = _pair(folder)
        self.name, self.camera, self._folder = _name(folder), camera, folder
        try:
            self.timestamps_ns = read_times(folder / _TIMES)
        except TrajectoryError as error:
            raise DatasetError(str(error)) from None
        late = np.flatnonzero(np.diff(self.timestamps_ns) <= 0)
        if late.size:
            raise DatasetError(f"{folder / _TIMES}: expected times that increase, frame {late[0] + 1} does not")
        left, right = (sorted((folder / side).glob("*.png")) for side in (self._sides.left, self._sides.right))
        for side, files in ((self._sides.left, left), (self._sides.right, right)):
            if len(files) != len(self.timestamps_ns):
                expected = f"one image a line of {_TIMES}, {len(self.timestamps_ns)}"
                raise DatasetError(f"{folder / side}: expected {expected}, got {len(files)}")
        unlike = next((pair for pair in zip(left, right, strict=True) if pair[0].name != pair[1].name), None)
        if unlike is not None:
            raise DatasetError(f"{unlike[1]}: expected the partner of {unlike[0].name}")
        self._files = list(zip(left, right, strict=True))

    def _truth(self) -> Trajectory | None:
        path = self._folder.parent.parent / "poses" / f"{self._folder.name}.txt"
        if not path.is_file():
            return None
        truth = read_kitti(path, self._folder / _TIMES)
        offset = _offset(_projections(self._folder)[self._sides.projections[0]])
        return moved(truth, np.array([1.0, 0, 0, 0, *offset]))

    @property
    def _readers(self) -> tuple[Callable[[Path], np.ndarray], Callable[[Path], np.ndarray]]:
        return (read_gray, read_gray) if self._sides.gray else (read_color, read_color)


def _name(folder: Path) -> str:
    return f"kitti_{folder.name}"


def _pair(folder: Path) -> _Pair:
    for pair in _PAIRS:
        if (folder / pair.left).is_dir() and (folder / pair.right).is_dir():
            return pair
    sides = " or ".join(f"{pair.left} and {pair.right}" for pair in _PAIRS)
    raise DatasetError(f"{folder}: expected the folders {sides}, got neither")


def _camera(folder: Path) -> Camera:
    """Return the left camera of the stereo pair, from the folder's own calibration.

    Raises:
        DatasetError: If there is no stereo pair, or its first image cannot be read.
        CameraError: If the calibration is missing or malformed.
    """
    pair = _pair(folder)
    projections = _projections(folder)
    left, right = (projections[name] for name in pair.projections)
    files = sorted((folder / pair.left).glob("*.png"))
    if not files:
        raise DatasetError(f"{folder / pair.left}: expected images, got none")
    height, width = read_gray(files[0]).shape
    baseline_m = float(left[0, 3] - right[0, 3]) / float(left[0, 0])
    if not baseline_m > 0:
        raise CameraError(f"{folder / _CALIBRATION}: expected the right camera to the right, got {baseline_m:g} m")
    fx, fy, cx, cy = map(float, (left[0, 0], left[1, 1], left[0, 2], left[1, 2]))
    return Camera(_name(folder), width, height, fx, fy, cx, cy, fps=10.0, baseline_m=baseline_m)


def _projections(folder: Path) -> dict[str, np.ndarray]:
    """Return the `(3, 4)` projection matrices of `calib.txt` by name."""
    path = folder / _CALIBRATION
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise CameraError(f"{path}: cannot be read: {error}") from None
    found: dict[str, np.ndarray] = {}
    for number, line in enumerate(lines, 1):
        name, _, values = line.partition(":")
        if not name.strip().startswith("P"):
            continue  # calibration of the laser, or an empty line
        try:
            matrix = np.array([float(word) for word in values.split()]).reshape(3, 4)
        except ValueError:
            raise CameraError(f"{path}:{number}: expected 12 numbers, got '{values.strip()[:60]}'") from None
        found[name.strip()] = matrix
    needed = [name for pair in _PAIRS for name in pair.projections if (folder / pair.left).is_dir()]
    missing = [name for name in needed if name not in found]
    if missing:
        raise CameraError(f"{path}: missing {', '.join(missing)}")
    return found


def _offset(projection: np.ndarray) -> np.ndarray:
    """Return the `(3,)` position of a camera in the axes of camera 0, whose poses KITTI gives."""
    return -np.linalg.solve(projection[:, :3], projection[:, 3])


def _fit(folder: Path) -> Fit:
    there = (folder / _CALIBRATION).is_file() and (folder / _TIMES).is_file()
    return Fit.LAYOUT if there and any((folder / pair.left).is_dir() for pair in _PAIRS) else Fit.NO


LOADER = Loader(
    "kitti",
    _fit,
    _camera,
    KittiDataset,
    files="calib.txt, times.txt, image_0 and image_1",
    parts=(_PAIRS[0].left, _CALIBRATION, _TIMES),
    reads_calibration=True,
)
