"""What recordings of two image files a frame have in common: color and depth, or left and right."""

import functools
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from jaxslam.errors import CameraError, DatasetError
from jaxslam.geometry.se3 import compose
from jaxslam.sensors.camera import Camera
from jaxslam.sensors.frame import Frame
from jaxslam.sensors.image_files import check_size
from jaxslam.sensors.rectification import RectifiedPair
from jaxslam.trajectory.trajectory import Trajectory

Files = list[tuple[Path, Path]]


class ImagePairs(ABC):
    """A recording that knows its files from the start and decodes those of a frame when it is asked for.

    A kind of recording sets the attributes, and says how files and ground truth are read.

    Attributes:
        name: What to call it in results.
        camera: The camera that took the frames, that of the rectified pair if two cameras as they are were given.
        timestamps_ns: `(n,)` int64 nanoseconds, strictly increasing.
    """

    name: str
    camera: Camera
    timestamps_ns: np.ndarray
    _files: Files
    _pair: RectifiedPair | None = None
    """What rectifies the images of two cameras as they are."""

    def _taken_with(self, camera: Camera | RectifiedPair) -> None:
        self._pair = camera if isinstance(camera, RectifiedPair) else None
        self.camera = camera.camera if isinstance(camera, RectifiedPair) else camera

    @property
    def ground_truth(self) -> Trajectory | None:
        """Poses of `camera`, read when first asked for; `TrajectoryError` if malformed, `None` if there are none."""
        return self._ground_truth

    @functools.cached_property
    def _ground_truth(self) -> Trajectory | None:
        return self._truth()

    @abstractmethod
    def _truth(self) -> Trajectory | None: ...

    @property
    @abstractmethod
    def _readers(self) -> tuple[Callable[[Path], np.ndarray], Callable[[Path], np.ndarray]]:
        """How the first and the second file of a frame are read."""

    def __len__(self) -> int:
        return len(self._files)

    def __getitem__(self, index: int) -> Frame:
        """Decode one frame, and rectify it where that is needed.

        Raises:
            IndexError: If there is no such frame.
            DatasetError: If an image is unreadable, or of another size than the camera's.
        """
        files = self._files[index]
        first, second = (read(file) for read, file in zip(self._readers, files, strict=True))
        for file, image in zip(files, (first, second), strict=True):
            check_size(file, image, self.camera)
        return self._frame(index, first, second)

    def _frame(self, index: int, first: np.ndarray, second: np.ndarray) -> Frame:
        stamp = int(self.timestamps_ns[index])
        if self._pair is not None:
            return self._pair.of(stamp, first, second)
        return Frame(stamp, first, right=second) if self.camera.is_stereo else Frame(stamp, first, second)


def check_stereo(camera: Camera) -> None:
    """Refuse a camera that is no stereo pair.

    Raises:
        CameraError: If it is none.
    """
    if not camera.is_stereo:
        raise CameraError(f"camera '{camera.name}': baseline_m: expected meters for a stereo pair, got none")


def check_present(files: Sequence[tuple[Path, Path]]) -> None:
    """Refuse lists of files that are not all there.

    Raises:
        DatasetError: If one is missing.
    """
    missing = [file for pair in files for file in pair if not file.is_file()]
    if missing:
        raise DatasetError(f"{missing[0]}: listed but missing, one of {len(missing)} such images")


def moved(bodies: Trajectory, T_body_camera: np.ndarray) -> Trajectory:
    """The trajectory of a camera that is fixed to another body, by its pose `(7,)` there, wxyz_xyz."""
    return Trajectory(bodies.timestamps_ns, compose(bodies.T_world_cam, T_body_camera[None]))
