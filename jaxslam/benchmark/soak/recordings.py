"""What is played in a soak test: a recording to and fro, with faults, and people anew each time in a rendered world."""

import threading
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, UInt8

from jaxslam.datasets import Dataset
from jaxslam.datasets.to_and_fro import ToAndFro
from jaxslam.errors import ModelError
from jaxslam.semantics import Detections, Detector, no_detections
from jaxslam.semantics.prompted.detector import boxes_of
from jaxslam.sensors.frame import Frame
from jaxslam.worlds.passing_people import PassingPeople

COVERED_FRAMES = 15
"""Number of frames for which something is before the lens."""
_NUM_REMEMBERED = 64
"""Number of frames whose people a detector can still be asked for."""


class WithPeople(ToAndFro):
    """A world played to and fro, with other people on each way: also a `Detector` of them, which sees the truth."""

    def __init__(self, people: PassingPeople, num_frames: int) -> None:
        """Take a world to play."""
        super().__init__(people.recording, num_frames)
        self._people = people
        self._masks: dict[bytes, Bool[np.ndarray, "h w"]] = {}
        self._lock = threading.Lock()

    def __getitem__(self, index: int) -> Frame:
        """Render frame `index`; raises `IndexError` outside `-n` to `n - 1`."""
        index = range(len(self))[index]
        source, seed = int(self.source_of(np.array(index))), index // self.frames_per_pass
        frame, mask = self._people.frame(source, seed)
        with self._lock:
            self._masks[_key(frame.image)] = mask
            while len(self._masks) > _NUM_REMEMBERED:
                del self._masks[next(iter(self._masks))]
        return self._played(index, frame)

    def detect(self, image: UInt8[np.ndarray, "h w 3"], /) -> Detections:
        """Find all people in a frame that was rendered lately; nobody in any other image."""
        with self._lock:
            mask = self._masks.get(_key(image))
        if mask is None or not mask.any():
            return no_detections()
        return Detections(boxes_of(mask[None]), np.ones(1, np.float32), ("person",), mask[None], None)


class Covered:
    """A recording in which the lens is covered now and then: frames are black and have no depth.

    Attributes:
        name: Name of the recording.
        camera: Its camera.
        timestamps_ns: `(n,)` int64 times of the frames, nanoseconds.
        ground_truth: True poses; `None` if they are unknown.
    """

    def __init__(self, recording: Dataset, every: int) -> None:
        """Cover the lens.

        Args:
            recording: The recording.
            every: Number of frames after which it happens again; 0 for never.
        """
        self._recording, self._every = recording, every
        self.name, self.camera = recording.name, recording.camera
        self.timestamps_ns, self.ground_truth = recording.timestamps_ns, recording.ground_truth

    def __len__(self) -> int:
        return len(self._recording)

    def is_covered(self, index: int) -> bool:
        """Tell whether something is before the lens at a frame."""
        return self._within(index, COVERED_FRAMES)

    def may_be_lost(self, index: int) -> bool:
        """Tell whether a frame may be lost: the lens is covered, or was within the last second."""
        return self._within(index, COVERED_FRAMES + round(self.camera.fps))

    def _within(self, index: int, num_frames: int) -> bool:
        """Tell whether a frame is one of the first few since the lens was covered."""
        return self._every > 0 and index >= self._every and index % self._every < num_frames

    def __getitem__(self, index: int) -> Frame:
        """Decode frame `index`; raises `IndexError` outside `-n` to `n - 1`."""
        index = range(len(self))[index]
        frame = self._recording[index]
        if not self.is_covered(index):
            return frame
        black, right = np.zeros_like(frame.image), None if frame.right is None else np.zeros_like(frame.right)
        depth_m = None if frame.depth_m is None else np.zeros_like(frame.depth_m)
        return replace(frame, image=black, depth_m=depth_m, right=right)


class FailingDetector:
    """A detector that fails now and then."""

    def __init__(self, detector: Detector, share: float, seed: int = 0) -> None:
        """Let a share of the calls of a detector fail, drawn from a seed."""
        self._detector, self._share = detector, share
        self._rng = np.random.default_rng([seed, 409])

    def __call__(self, image: UInt8[np.ndarray, "h w 3"], /) -> Detections:
        """Find objects in an image.

        Raises:
            ModelError: In a share of the calls.
        """
        if self._rng.random() < self._share:
            raise ModelError("failed on purpose")
        return self._detector(image)


def _key(image: np.ndarray) -> bytes:
    """Return some pixels, by which a frame is known: they are noisy, and so differ from frame to frame."""
    return image[::37, ::41].tobytes()
