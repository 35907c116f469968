"""Base class of recordings with two image files per frame: color and depth, or left and right."""

import functools
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

import numpy as np

from jaxslam.errors import CameraError, DatasetError
from jaxslam.geometry.se3 import compose
from jaxslam.sensors.camera import Camera
from jaxslam.sensors.frame import Frame
from jaxslam.sensors.image_files import check_size
from jaxslam.sensors.rectification import RectifiedPair
from jaxslam.trajectory.trajectory import Trajectory

Files = Sequence[tuple[Path, Path | None]]
"""The two files of each frame; `None` for a frame without a depth image."""


class ImagePairs(ABC):
    """A recording that lists its files at the start and decodes those of a frame on access.

    A subclass sets the attributes and defines how images and ground truth are read.

    Attributes:
        name: Name of the recording in results.
        camera: The camera that took the frames, or the rectified camera of a stereo pair that is not rectified.
        timestamps_ns: `(n,)` int64 timestamps in nanoseconds, strictly increasing.
    """

    name: str
    camera: Camera
    timestamps_ns: np.ndarray
    _files: Files
    _pair: RectifiedPair | None = None
    """Rectifies the images of a stereo pair; `None` if they are already rectified or there is no pair."""

    def _taken_with(self, camera: Camera | RectifiedPair) -> None:
        self._pair = camera if isinstance(camera, RectifiedPair) else None
        self.camera = camera.camera if isinstance(camera, RectifiedPair) else camera

    @property
    def ground_truth(self) -> Trajectory | None:
        """The poses of `camera`, read on first access; `None` if there are none.

        Raises:
            TrajectoryError: If the file is malformed.
        """
        return self._ground_truth

    @functools.cached_property
    def _ground_truth(self) -> Trajectory | None:
        return self._truth()

    @abstractmethod
    def _truth(self) -> Trajectory | None: ...

    @property
    @abstractmethod
    def _readers(self) -> tuple[Callable[[Path], np.ndarray], Callable[[Path], np.ndarray]]:
        """The functions that read the first and the second file of a frame."""

    def image_size(self) -> tuple[int, int]:
        """Read the width and height of the first image, pixels.

        Raises:
            DatasetError: If it cannot be read.
        """
        height, width = self._readers[0](self._files[0][0]).shape[:2]
        return width, height

    def __len__(self) -> int:
        return len(self._files)

    def __getitem__(self, index: int) -> Frame:
        """Decode one frame, and rectify it where needed.

        Raises:
            IndexError: If there is no such frame.
            DatasetError: If an image is unreadable, or its size is not the camera's.
        """
        files = self._files[index]
        first, second = (
            None if file is None else self._read(read, file) for read, file in zip(self._readers, files, strict=True)
        )
        assert first is not None  # every frame has a color or left image
        return Frame(int(self.timestamps_ns[index]), first) if second is None else self._frame(index, first, second)

    def _read(self, read: Callable[[Path], np.ndarray], file: Path) -> np.ndarray:
        image = read(file)
        check_size(file, image, self.camera)
        return image

    def _frame(self, index: int, first: np.ndarray, second: np.ndarray) -> Frame:
        stamp = int(self.timestamps_ns[index])
        if self._pair is not None:
            return self._pair.of(stamp, first, second)
        return Frame(stamp, first, right=second) if self.camera.is_stereo else Frame(stamp, first, second)


def check_stereo(camera: Camera) -> None:
    """Refuse a camera that is not a stereo pair.

    Raises:
        CameraError: If the camera has no baseline, or has depth images.
    """
    if not camera.is_stereo:
        raise CameraError(f"camera '{camera.name}': baseline_m: expected meters for a stereo pair, got none")


def check_present(files: Iterable[Path]) -> None:
    """Refuse files of which some do not exist.

    Raises:
        DatasetError: If a file is missing.
    """
    missing = [file for file in files if not file.is_file()]
    if missing:
        raise DatasetError(f"{missing[0]}: listed but missing, one of {len(missing)} such images")


def moved(bodies: Trajectory, T_body_camera: np.ndarray) -> Trajectory:
    """Return the trajectory of a camera fixed to a body, from the body's trajectory.

    Args:
        bodies: The trajectory of the body.
        T_body_camera: `(7,)` wxyz_xyz pose of the camera in the axes of the body.
    """
    return Trajectory(bodies.timestamps_ns, compose(bodies.T_world_cam, T_body_camera[None]))
