"""A detector that knows the scene: the true mask of every frame, to study masks without a network."""

import hashlib
import threading
import zlib
from collections.abc import Iterable

import numpy as np
from jaxtyping import UInt8

from jaxslam.datasets.synthetic.dataset import SyntheticDataset, SyntheticFrame
from jaxslam.errors import ConfigError, DatasetError, nearest
from jaxslam.semantics import Detections, no_detections

_LABELS = ("person", "box")


class SceneDetector:
    """Finds what moves in the frames of a synthetic recording, exactly: a `Detector`.

    A frame is known by the bytes of its image. Frames are rendered once more for that, in turn, until the image is
    found; what is kept of each is about a kilobyte. May be called from any thread.
    """

    def __init__(
        self,
        dataset: SyntheticDataset,
        rendered: Iterable[SyntheticFrame] = (),
        labels: Iterable[str] = _LABELS,
    ) -> None:
        """Take a recording whose frames will come.

        Args:
            dataset: The recording.
            rendered: Frames of it that are rendered already: they need not be once more.
            labels: Labels to find: `person`, which networks know, and `box`, carried boxes, which they do not.

        Raises:
            ConfigError: A label is neither.
        """
        self._dataset, self._labels = dataset, frozenset(labels)
        if unknown := sorted(self._labels.difference(_LABELS)):
            raise ConfigError(f"labels: no actor is a '{unknown[0]}'{nearest(unknown[0], _LABELS)}")
        self._actors: dict[bytes, bytes] = {}
        self._lock = threading.Lock()
        known_ns = [self._keep(frame) for frame in rendered]
        self._unseen = iter(np.flatnonzero(~np.isin(dataset.timestamps_ns, known_ns)).tolist())

    def __call__(self, image: UInt8[np.ndarray, "h w 3"], /) -> Detections:
        """Everything that moves in a frame of the recording, one mask an actor, with a score of 1; largest first.

        Args:
            image: The image of one of its frames, as it is.

        Raises:
            DatasetError: It is none of them.
        """
        compressed = self._found(image)
        if compressed is None:
            raise DatasetError(
                f"image: expected that of one of the {len(self._dataset)} frames of {self._dataset.name},"
                f" got another of shape {image.shape}"
            )
        numbers = np.frombuffer(zlib.decompress(compressed), np.uint8).reshape(image.shape[:2])
        return self._detections(numbers)

    def _found(self, image: np.ndarray) -> bytes | None:
        """Return the mask of every actor in an image; `None` if it is not of the recording."""
        if image.shape != (self._dataset.height, self._dataset.width, 3):
            return None
        key = _digest(image)
        with self._lock:
            while key not in self._actors and (index := next(self._unseen, None)) is not None:
                self._keep(self._dataset.render(index))
            return self._actors.get(key)

    def note(self, frame: SyntheticFrame) -> None:
        """Remember where everybody is in a frame of the recording, so that it need not be rendered once more."""
        with self._lock:
            self._keep(frame)

    def _keep(self, frame: SyntheticFrame) -> int:
        """Remember where everybody is in a frame; gives its time."""
        self._actors[_digest(frame.rgb)] = zlib.compress(frame.instance_mask.astype(np.uint8).tobytes(), 1)
        return frame.timestamp_ns

    def _detections(self, numbers: np.ndarray) -> Detections:
        label = {k: self._dataset.actors[k - 1].label for k in np.unique(numbers[numbers > 0]).tolist()}
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
