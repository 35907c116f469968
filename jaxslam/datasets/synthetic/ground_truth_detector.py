"""A detector that knows the scene: the true mask of every frame, to study masks without a network."""

import hashlib
import threading
import zlib
from collections.abc import Iterable
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import UInt8

from jaxslam.datasets.synthetic.recording_folder import RenderedFrame, RenderedRecording
from jaxslam.errors import DatasetError
from jaxslam.semantics import Detections, no_detections
from jaxslam.semantics.class_names import FoundClasses, find_classes
from jaxslam.sensors.frame import Frame

_LABELS = ("person", "box")


class LabeledFrame(RenderedFrame, Protocol):
    """A rendered frame in which the numbers of things and people are known."""

    @property
    def instance_mask(self) -> np.ndarray:
        """Numbers, `(height, width)` int32; 0 on pixels without one."""
        ...

    @property
    def measured(self) -> Frame:
        """Frame as a camera would deliver it."""
        ...


@runtime_checkable
class LabeledRecording(RenderedRecording, Protocol):
    """A rendered recording in which the labels of things and people are known: a room, or a world."""

    labels: tuple[str, ...]
    """Label of each; that of number `k` is `labels[k - 1]`."""

    def render(self, index: int) -> LabeledFrame:
        """Frame `index` with its ground truth."""
        ...


class SceneDetector:
    """Finds things and people of some labels in the frames of a rendered recording, exactly: a `Detector`.

    A frame is known by the bytes of its image. Frames are rendered once more for that, in turn, until the image is
    found; what is kept of each is about a kilobyte. May be called from any thread.
    """

    def __init__(
        self,
        dataset: LabeledRecording,
        rendered: Iterable[LabeledFrame] = (),
        labels: Iterable[str] = _LABELS,
    ) -> None:
        """Take a recording whose frames will come.

        Args:
            dataset: The recording.
            rendered: Frames of it that are rendered already: they need not be once more.
            labels: Labels to find: `person` and other classes and groups of classes that networks know, and `box`,
                carried boxes, which they do not.

        Raises:
            ConfigError: A label is none of those, and none of the recording.
        """
        self._dataset = dataset
        wanted, of_scene = tuple(labels), {*_LABELS, *dataset.labels}
        classes = find_classes(wanted, of_scene) if wanted else FoundClasses((), ())
        self._labels = frozenset(classes.known)
        self._shape = dataset.camera.height, dataset.camera.width, 3
        self._actors: dict[bytes, bytes] = {}
        self._lock = threading.Lock()
        known_ns = [self._keep(frame) for frame in rendered]
        self._unseen = iter(np.flatnonzero(~np.isin(dataset.timestamps_ns, known_ns)).tolist())

    def __call__(self, image: UInt8[np.ndarray, "h w 3"], /) -> Detections:
        """Find all with one of the labels in a frame of the recording: one mask each, a score of 1, largest first.

        Args:
            image: The image of one of its frames, as it is.

        Raises:
            DatasetError: It is none of them.
        """
        if image.shape == self._shape and not image.any():  # a camera that fails shows nothing, whatever is there
            return no_detections()
        compressed = self._found(image)
        if compressed is None:
            raise DatasetError(
                f"image: expected that of one of the {len(self._dataset)} frames of {self._dataset.name},"
                f" got another of shape {image.shape}"
            )
        numbers = np.frombuffer(zlib.decompress(compressed), np.uint16).reshape(image.shape[:2])
        return self._detections(numbers)

    def _found(self, image: np.ndarray) -> bytes | None:
        """Return the mask of every actor in an image; `None` if it is not of the recording."""
        if image.shape != self._shape:
            return None
        key = _digest(image)
        with self._lock:
            while key not in self._actors and (index := next(self._unseen, None)) is not None:
                self._keep(self._dataset.render(index))
            return self._actors.get(key)

    def note(self, frame: LabeledFrame) -> None:
        """Remember where everybody is in a frame of the recording, so that it need not be rendered once more."""
        with self._lock:
            self._keep(frame)

    def _keep(self, frame: LabeledFrame) -> int:
        """Remember where everybody is in a frame; gives its time."""
        key = _digest(frame.rgb)
        if key not in self._actors:  # a camera that is frozen goes on showing what was there before
            self._actors[key] = zlib.compress(frame.instance_mask.astype(np.uint16).tobytes(), 1)
        return frame.timestamp_ns

    def _detections(self, numbers: np.ndarray) -> Detections:
        label = {k: self._dataset.labels[k - 1] for k in np.unique(numbers[numbers > 0]).tolist()}
        found = [k for k in label if label[k] in self._labels]
        if not found:
            return no_detections()
        found.sort(key=lambda k: -np.count_nonzero(numbers == k))
        masks = np.stack([numbers == k for k in found])
        boxes = np.array([_box(mask) for mask in masks], np.float32)
        return Detections(boxes, np.ones(len(found), np.float32), tuple(label[k] for k in found), masks, None)


def _digest(image: np.ndarray) -> bytes:
    return hashlib.blake2b(image.tobytes(), digest_size=16).digest()


def _box(mask: np.ndarray) -> tuple[int, int, int, int]:
    """Left, top, right and bottom edge of a mask that is not empty."""
    columns, rows = np.flatnonzero(mask.any(axis=0)), np.flatnonzero(mask.any(axis=1))
    return columns[0], rows[0], columns[-1] + 1, rows[-1] + 1
