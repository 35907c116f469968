"""What a recording is to the rest of jaxslam, and what a loader of one kind of recording provides."""

from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum
from pathlib import Path
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np

from jaxslam.sensors.camera import Camera
from jaxslam.sensors.frame import Frame
from jaxslam.sensors.rectification import RectifiedPair
from jaxslam.trajectory.trajectory import Trajectory


class Dataset(Protocol):
    """A finite recording: frames in the order of time, one camera, and ground truth if there is any."""

    @property
    def name(self) -> str:
        """What to call the recording in results."""
        ...

    @property
    def camera(self) -> Camera:
        """The camera that took every frame."""
        ...

    @property
    def timestamps_ns(self) -> np.ndarray:
        """`(n,)` int64 times of the frames in nanoseconds, strictly increasing."""
        ...

    @property
    def ground_truth(self) -> Trajectory | None:
        """The true trajectory, on the frames' clock but at its own times; `None` if there is none."""
        ...

    def __len__(self) -> int: ...

    def __getitem__(self, index: int) -> Frame:
        """Decode frame `index`; raises `IndexError` outside `-n` to `n - 1`."""
        ...


class Unmatched(NamedTuple):
    """Images left out because no image of the other kind was taken at nearly the same time.

    Of a pair `color` counts those of the left camera, and `depth` those of the right one, which stand in for depth.
    """

    color: int
    depth: int


@runtime_checkable
class Associated(Protocol):
    """A recording whose two images of a frame were taken apart and have been matched by time."""

    @property
    def unmatched(self) -> Unmatched:
        """How many images found no partner."""
        ...


class Fit(IntEnum):
    """How surely a loader recognizes a folder; the surest loader opens it."""

    NO = 0
    FOLDERS = 1
    """Folders of images are there."""
    LAYOUT = 2
    """The files are there."""
    NAME = 3
    """The files are there and the folder's name says so too."""


@dataclass(frozen=True)
class Loader:
    """One kind of recording. A module of this package that holds a `LOADER` is found by itself.

    Attributes:
        kind: The name by which it is chosen.
        fit: How surely a folder is of this kind.
        camera: What a folder was taken with, as its name or a calibration in it tells; `None` if neither does.
        open: Opens a folder with its camera.
        rectifies: Whether `open` also takes a pair that is not rectified.
    """

    kind: str
    fit: Callable[[Path], Fit]
    camera: Callable[[Path], Camera | RectifiedPair | None]
    open: Callable[[Path, Any], Dataset]
    rectifies: bool = False
