"""The protocol of a recording, and of the loader of one kind of recording."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import IntEnum
from pathlib import Path
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np

from jaxslam.sensors.camera import Camera
from jaxslam.sensors.frame import Frame
from jaxslam.sensors.imu import ImuSamples, ImuSheet
from jaxslam.sensors.rectification import RectifiedPair
from jaxslam.trajectory.trajectory import Trajectory


class Dataset(Protocol):
    """A finite recording: frames in the order of time, one camera, and ground truth if available."""

    @property
    def name(self) -> str:
        """Name of the recording in results."""
        ...

    @property
    def camera(self) -> Camera:
        """The camera that took every frame."""
        ...

    @property
    def timestamps_ns(self) -> np.ndarray:
        """`(n,)` int64 timestamps of the frames in nanoseconds, strictly increasing."""
        ...

    @property
    def ground_truth(self) -> Trajectory | None:
        """The true trajectory, on the clock of the frames but at its own times; `None` if unknown."""
        ...

    def __len__(self) -> int: ...

    def __getitem__(self, index: int) -> Frame:
        """Decode frame `index`; raises `IndexError` outside `-n` to `n - 1`."""
        ...


class Unmatched(NamedTuple):
    """Counts of images left out because no image of the other kind was taken at nearly the same time.

    Attributes:
        color: Number of color images left out, or of images of the left camera. A color image without a depth image
            is left out only before the first frame with depth and after the last one.
        depth: Number of depth images left out, or of images of the right camera.
    """

    color: int
    depth: int


@runtime_checkable
class Associated(Protocol):
    """A recording whose frames consist of two images taken separately and matched by time."""

    @property
    def unmatched(self) -> Unmatched:
        """The number of images without a partner."""
        ...


def frames_with_depth(dataset: Dataset) -> np.ndarray:
    """Return `(n,)` bool, true for frames that have a depth image; all true where a recording does not tell."""
    return getattr(dataset, "has_depth", np.ones(len(dataset), bool))


def imu_sheet(dataset: Dataset) -> ImuSheet | None:
    """Return the data sheet of the IMU whose samples come with the frames of a recording; `None` without one."""
    return getattr(dataset, "imu", None)


def imu_samples(dataset: Dataset) -> ImuSamples | None:
    """Return all samples of the IMU of a recording, those around the frames too; `None` without one."""
    return getattr(dataset, "imu_samples", None)


def with_imu(frame: Frame, samples: ImuSamples | None, since_ns: int | None) -> Frame:
    """Return a frame with the samples of the IMU since the frame before; as it is where either is missing.

    Args:
        frame: The frame.
        samples: All samples of the recording.
        since_ns: Time of the frame before, nanoseconds.
    """
    if samples is None or since_ns is None:
        return frame
    return replace(frame, imu=samples.between(since_ns, frame.timestamp_ns))


class Fit(IntEnum):
    """How surely a loader recognizes a folder; the loader with the highest value opens it."""

    NO = 0
    FOLDERS = 1
    """The folder contains folders of images."""
    LAYOUT = 2
    """The folder contains the files of the layout."""
    NAME = 3
    """The folder contains the files of the layout, and its name confirms it."""


@dataclass(frozen=True)
class Loader:
    """One kind of recording. Each module of `jaxslam.datasets.loaders` that defines a `LOADER` is registered.

    Attributes:
        kind: The name that selects this kind of recording.
        fit: Function that tells how surely a folder is of this kind.
        camera: Function that finds the camera of a folder from its name or a calibration in it; it returns `None` if
            neither tells.
        open: Function that opens a folder with its camera.
        rectifies: Whether `open` also takes a stereo pair that is not rectified.
        files: Files and folders that a recording of this kind has, for the message about a folder without any.
        parts: Files and folders that a recording of this kind has, for the message about a folder that has at least
            half of them, but not all.
        reads_calibration: Whether `camera` reads calibration files in the folder, rather than the name of the folder.
        depth_scale_per_m: Counts of the depth images per meter that the layout prescribes; `None` if it does not.
    """

    kind: str
    fit: Callable[[Path], Fit]
    camera: Callable[[Path], Camera | RectifiedPair | None]
    open: Callable[[Path, Any], Dataset]
    rectifies: bool = False
    files: str = ""
    parts: tuple[str, ...] = ()
    reads_calibration: bool = False
    depth_scale_per_m: float | None = None
