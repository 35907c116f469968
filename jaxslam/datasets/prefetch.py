"""Parts of a recording, and decoding of frames ahead of their use."""

from collections import deque
from collections.abc import Generator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from itertools import islice
from typing import Protocol, TypeVar

import numpy as np

from jaxslam.datasets.protocol import Dataset, frames_with_depth, imu_samples, imu_sheet
from jaxslam.errors import DatasetError
from jaxslam.sensors.camera import Camera
from jaxslam.sensors.frame import Frame
from jaxslam.sensors.imu import ImuSamples, ImuSheet
from jaxslam.trajectory.trajectory import Trajectory

_Item_co = TypeVar("_Item_co", covariant=True)


class Subset:
    """Frames `start` to `stop - 1` of another recording, all or every nth, with its camera and whole ground truth.

    Attributes:
        whole: The other recording.
        indices: Indices of the chosen frames in the other recording.
        name: Name of the part in results, such as `fr1_xyz[0:100]`.
    """

    def __init__(self, dataset: Dataset, start: int = 0, stop: int | None = None, step: int = 1) -> None:
        """Choose frames as a slice does: negative indices count from the end.

        Args:
            dataset: The recording to choose from.
            start: Index of the first frame.
            stop: Index after the last frame; `None` for the end.
            step: Step between chosen frames.

        Raises:
            DatasetError: If no frame is left.
        """
        self.whole = dataset
        self.indices = range(len(dataset))[start:stop:step]
        if not self.indices:
            raise DatasetError(f"{dataset.name}: expected a part of {len(dataset)} frames, got {start}:{stop}")
        every = f":{step}" if step > 1 else ""
        self.name = f"{dataset.name}[{self.indices.start}:{self.indices.stop}{every}]"

    @property
    def camera(self) -> Camera:
        """The camera of the whole recording."""
        return self.whole.camera

    @property
    def timestamps_ns(self) -> np.ndarray:
        """`(n,)` int64 timestamps of the chosen frames in nanoseconds."""
        return self.whole.timestamps_ns[self.indices.start : self.indices.stop : self.indices.step]

    @property
    def ground_truth(self) -> Trajectory | None:
        """The ground truth of the whole recording."""
        return self.whole.ground_truth

    @property
    def has_depth(self) -> np.ndarray:
        """`(n,)` bool, true for chosen frames that have a depth image."""
        return frames_with_depth(self.whole)[self.indices.start : self.indices.stop : self.indices.step]

    @property
    def imu(self) -> ImuSheet | None:
        """Data sheet of the IMU of the whole recording; `None` without one."""
        return imu_sheet(self.whole)

    @property
    def imu_samples(self) -> ImuSamples | None:
        """All samples of the IMU of the whole recording; `None` without one."""
        return imu_samples(self.whole)

    def __len__(self) -> int:
        return len(self.indices)

    def __getitem__(self, index: int) -> Frame:
        index = range(len(self))[index]
        return self.with_samples(index, self.whole[self.indices[index]])

    def with_samples(self, index: int, frame: Frame) -> Frame:
        """Return a chosen frame with the samples of the IMU since the chosen frame before it."""
        if self.imu_samples is None or self.indices.step == 1:
            return frame
        fps = self.camera.fps / self.indices.step
        return replace(frame, imu=self.imu_samples.since_last_frame(self.timestamps_ns, index, fps))


class Indexed(Protocol[_Item_co]):
    """A sequence that `prefetch` can read: a recording, or anything with a length and items."""

    def __len__(self) -> int: ...

    def __getitem__(self, index: int) -> _Item_co: ...


def prefetch(dataset: Indexed[_Item_co], ahead: int = 4) -> Generator[_Item_co]:
    """Yield every frame in order, decoded in one background thread while the caller works on earlier ones.

    The thread ends with the iterator: when it is exhausted, closed, or discarded half-way.

    Args:
        dataset: The recording.
        ahead: Number of frames to decode ahead, at least 1; as many are held in memory.

    Raises:
        JaxSlamError: Whatever decoding a frame raised, when that frame is due.
    """
    indices = iter(range(len(dataset)))
    pool = ThreadPoolExecutor(1, thread_name_prefix="jaxslam-prefetch")
    try:
        pending = deque(pool.submit(dataset.__getitem__, index) for index in islice(indices, max(ahead, 1)))
        while pending:
            frame = pending.popleft().result()
            pending.extend(pool.submit(dataset.__getitem__, index) for index in islice(indices, 1))
            yield frame
    finally:
        pool.shutdown(wait=True, cancel_futures=True)
