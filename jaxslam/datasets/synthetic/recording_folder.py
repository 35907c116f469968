"""What writers of rendered recordings share: what they take, and folders that appear when they are complete."""

import contextlib
import shutil
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import NamedTuple, Protocol, TypeAlias, runtime_checkable

import cv2
import numpy as np

from jaxslam.errors import DatasetError
from jaxslam.sensors.camera import Camera
from jaxslam.sensors.imu import ImuSamples, ImuSheet, ImuStates
from jaxslam.trajectory.trajectory import Trajectory

Progress: TypeAlias = Callable[[int, int], None]
"""Called after each frame with the number of frames written and to be written."""


class RenderedFrame(Protocol):
    """A frame that can be written."""

    @property
    def timestamp_ns(self) -> int:
        """Time of the frame."""
        ...

    @property
    def rgb(self) -> np.ndarray:
        """Color as measured, `(height, width, 3)` uint8."""
        ...

    @property
    def depth_m(self) -> np.ndarray:
        """Depth as measured in meters, `(height, width)` float32, 0 where missing."""
        ...

    @property
    def right(self) -> np.ndarray | None:
        """Color as the right camera of a pair measured it, `(height, width, 3)` uint8; `None` without one."""
        ...

    @property
    def mask_images(self) -> Mapping[str, np.ndarray]:
        """Masks, `(height, width)` uint8 or uint16, by the name of their folder."""
        ...


class RenderedRecording(Protocol):
    """A rendered recording that can be written."""

    name: str
    camera: Camera
    timestamps_ns: np.ndarray
    ground_truth: Trajectory

    def __len__(self) -> int: ...

    def render(self, index: int) -> RenderedFrame:
        """Frame `index` with its ground truth."""
        ...


@runtime_checkable
class InertialRecording(Protocol):
    """A recording that may have an IMU, see `WorldRecording`."""

    imu: ImuSheet | None
    imu_samples: ImuSamples | None
    imu_states: ImuStates | None


class RecordedImu(NamedTuple):
    """The IMU of a recording: its data sheet, its samples, and what is true of it at the times of the frames."""

    sheet: ImuSheet
    samples: ImuSamples
    states: ImuStates


def imu_of(dataset: RenderedRecording) -> RecordedImu | None:
    """Return the IMU of a recording; `None` if it has none."""
    if not isinstance(dataset, InertialRecording):
        return None
    sheet, samples, states = dataset.imu, dataset.imu_samples, dataset.imu_states
    if sheet is None or samples is None or states is None:
        return None
    return RecordedImu(sheet, samples, states)


def check_is_pair(dataset: RenderedRecording) -> None:
    """Refuse a recording that is not of a stereo pair.

    Raises:
        DatasetError: If it is of a camera with depth images.
    """
    if not dataset.camera.is_stereo:
        raise DatasetError(f"{dataset.name}: expected a stereo pair (baseline_m), got a camera with depth images")


@contextlib.contextmanager
def filling(folder: str | Path) -> Iterator[Path]:
    """Yield `<folder>.partial`, which becomes `folder` if the block raises no error.

    A folder of the wanted name is complete, and what an interrupted run has left is overwritten by the next.

    Args:
        folder: Folder to write to; it must not exist, or be empty.

    Raises:
        DatasetError: The folder is in use, or a file cannot be written.
    """
    folder = Path(folder).resolve()
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise DatasetError(f"{folder}: expected no such folder or an empty one, got one in use")
    partial = folder.with_name(folder.name + ".partial")
    try:
        shutil.rmtree(partial, ignore_errors=True)
        yield partial
        if folder.exists():
            folder.rmdir()
        partial.rename(folder)
    except OSError as problem:
        raise DatasetError(f"{partial}: cannot be written: {problem}") from problem


def write_frames(
    dataset: RenderedRecording,
    images_of: Callable[[int, RenderedFrame], Mapping[Path, np.ndarray]],
    progress: Progress | None,
) -> None:
    """Render all frames and write their images.

    Args:
        dataset: Recording to write.
        images_of: Returns the images of a frame with its index by path: gray or RGB uint8, or gray uint16.
        progress: Called after each frame.

    Raises:
        DatasetError: An image cannot be written.
    """
    for index in range(len(dataset)):
        for path, image in images_of(index, dataset.render(index)).items():
            _write_image(path, image)
        if progress is not None:
            progress(index + 1, len(dataset))


def write_texts(folder: Path, texts: Mapping[str, str] | None) -> None:
    """Write text files into a folder, given their contents by name."""
    for name, text in (texts or {}).items():
        (folder / name).write_text(text, encoding="utf-8")


def both_sides(frame: RenderedFrame) -> tuple[np.ndarray, np.ndarray]:
    """Return the two images of a stereo pair, `(height, width, 3)` uint8.

    Raises:
        DatasetError: The frame has no right image.
    """
    if frame.right is None:
        raise DatasetError(f"frame at {frame.timestamp_ns} ns: expected the right image of a pair, got none")
    return frame.rgb, frame.right


def _write_image(path: Path, image: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    stored = image if image.ndim == 2 else image[..., ::-1]  # OpenCV's order of channels is BGR
    if not cv2.imwrite(str(path), np.ascontiguousarray(stored)):
        raise DatasetError(f"{path}: cannot be written")
