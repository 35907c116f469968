"""A recording played forward and backward again and again, for runs of any length."""

from dataclasses import replace

import numpy as np

from jaxslam.datasets.protocol import Dataset
from jaxslam.errors import DatasetError
from jaxslam.sensors.frame import Frame
from jaxslam.trajectory.trajectory import Trajectory

_MIN_FRAMES = 2


class ToAndFro:
    """A recording of any length: another one played to its end, back to its beginning, and so on.

    Frames follow each other at the intervals of the other recording. On the way back, depth that was taken after its
    image comes before it, and a rolling shutter reads the last row first. Samples of an IMU are left out, as they would
    not fit the motion.

    Attributes:
        name: Name in results, such as `fr1_xyz, 12000 frames to and fro`.
        camera: Camera of the other recording.
        timestamps_ns: `(n,)` int64 times of the frames, nanoseconds.
        frames_per_pass: Number of frames of one way.
        ground_truth: True poses at the times of the frames, interpolated; `None` if they are unknown.
    """

    def __init__(self, dataset: Dataset, num_frames: int) -> None:
        """Take a recording to play.

        Args:
            dataset: The recording.
            num_frames: Number of frames to play.

        Raises:
            DatasetError: If the recording has fewer than two frames, or fewer than one is to be played.
        """
        if len(dataset) < _MIN_FRAMES:
            raise DatasetError(f"{dataset.name}: expected at least {_MIN_FRAMES} frames, got {len(dataset)}")
        if num_frames < 1:
            raise DatasetError(f"num_frames: expected at least 1, got {num_frames}")
        self._dataset = dataset
        self.name, self.camera = f"{dataset.name}, {num_frames} frames to and fro", dataset.camera
        self.frames_per_pass = len(dataset) - 1
        shown = dataset.timestamps_ns[self.source_of(np.arange(num_frames))]
        self.timestamps_ns = shown[0] + np.cumsum(np.abs(np.diff(shown, prepend=shown[0])))
        self.ground_truth = self._truth()

    def __len__(self) -> int:
        return len(self.timestamps_ns)

    def __getitem__(self, index: int) -> Frame:
        """Decode frame `index`; raises `IndexError` outside `-n` to `n - 1`."""
        index = range(len(self))[index]
        return self._played(index, self._dataset[int(self.source_of(np.array(index)))])

    def source_of(self, index: np.ndarray) -> np.ndarray:
        """Return the frames of the other recording that are shown at some frames."""
        along = index % (2 * self.frames_per_pass)
        return np.minimum(along, 2 * self.frames_per_pass - along)

    def _played(self, index: int, source: Frame) -> Frame:
        """Return a frame of the other recording as frame `index`."""
        timestamp_ns, delay_ns = int(self.timestamps_ns[index]), source.depth_delay_ns
        # The frame at a turn comes at the end of the way to it.
        backward = max(index - 1, 0) // self.frames_per_pass % 2 == 1
        return replace(
            source,
            timestamp_ns=timestamp_ns,
            depth_timestamp_ns=timestamp_ns + (-delay_ns if backward else delay_ns),
            imu=None,
            played_backward=backward,
        )

    def _truth(self) -> Trajectory | None:
        truth = self._dataset.ground_truth
        if truth is None or not len(truth):
            return None
        times = self._dataset.timestamps_ns
        known = (times >= truth.timestamps_ns[0]) & (times <= truth.timestamps_ns[-1])
        source = self.source_of(np.arange(len(self)))
        shown = known[source]
        return Trajectory(self.timestamps_ns[shown], truth.at(times).T_world_cam[source[shown]])
