"""The sequence of a run, opened: frames, folder, and what of it goes into a result."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from jaxslam.benchmark.suites.provenance import camera_sha256, data_sha256, world_sha256
from jaxslam.benchmark.suites.suite import Sequence as Clip
from jaxslam.datasets import Associated, Dataset, Subset, open_dataset
from jaxslam.datasets.catalog import find_recording
from jaxslam.datasets.synthetic import SyntheticDataset
from jaxslam.datasets.synthetic.cached_dataset import StoredRoom
from jaxslam.errors import BenchmarkError, JaxSlamError
from jaxslam.worlds.stored_world import StoredWorld


@dataclass(frozen=True)
class OpenedClip:
    """A sequence of a suite, opened.

    Attributes:
        clip: Sequence.
        dataset: Frames of the sequence.
        whole: All frames of its recording, room or world.
        folder: Folder of the recording; `None` for a room or a world.
    """

    clip: Clip
    dataset: Dataset
    whole: Dataset
    folder: Path | None

    @property
    def rate_hz(self) -> float:
        """Frames a second; that of the camera if there is one frame only."""
        steps_ns = np.diff(self.dataset.timestamps_ns)
        return round(1e9 / float(np.median(steps_ns)), 3) if len(steps_ns) else self.dataset.camera.fps

    def figures(self) -> dict[str, Any]:
        """Return what a result says of the sequence: `images`, `rate_hz`, and hashes of its data and camera file.

        Images are the color images, or pairs, of the sequence, including those without a depth image.
        """
        without_depth = self.dataset.unmatched.color if isinstance(self.dataset, Associated) else 0
        return {
            "images": len(self.dataset) + without_depth,
            "rate_hz": self.rate_hz,
            "data_sha256": self._data_sha256(),
            "camera_sha256": camera_sha256(self.clip),
        }

    def _data_sha256(self) -> str | None:
        if self.clip.world:
            return world_sha256(self.clip.world)
        return None if self.folder is None else data_sha256(self.folder)


def opened(clip: Clip, root: Path | None, rooms: Path | None = None, *, rendered: bool = True) -> OpenedClip:
    """Open a sequence.

    Args:
        clip: Sequence to open.
        root: Folder in which recordings are looked for first.
        rooms: Folder in which rendered frames are kept. `None` to render those of a room as they are asked for.
        rendered: Whether frames that are kept are rendered now, before anything is timed.

    Raises:
        BenchmarkError: If its recording is not on this machine, or of another sensor than it says.
    """
    folder = None
    if clip.room is not None and rooms is not None:
        whole: Dataset = StoredRoom(clip.room, rooms / clip.name)
        if rendered:
            whole.render_all()
    elif clip.room is not None:
        whole = SyntheticDataset(clip.room)
    elif clip.world:
        whole = _world(clip, rendered=rendered)
    else:
        folder = find_recording(clip.recording, root)
        if folder is None:
            raise BenchmarkError(f"{clip.recording}: not on this machine; to get it: jaxslam data get {clip.recording}")
        whole = open_dataset(folder, camera=clip.camera)
    taken_with = "stereo" if whole.camera.is_stereo else "rgbd"
    if clip.sensor not in (None, taken_with):
        raise BenchmarkError(f"{clip.name}: sensor: expected {clip.sensor}, got a recording of {taken_with}")
    dataset = whole if clip.whole else Subset(whole, clip.start, clip.stop, clip.every)
    return OpenedClip(clip, dataset, whole, folder)


def _world(clip: Clip, *, rendered: bool) -> StoredWorld:
    """Open the world of a clip, whose frames are kept in the user's cache.

    Raises:
        BenchmarkError: If it cannot be opened.
    """
    try:
        world = StoredWorld(clip.world)
    except JaxSlamError as error:
        raise BenchmarkError(f"{clip.name}: {error}") from None
    if rendered:
        world.render_all(range(len(world))[clip.start : clip.stop : clip.every])
    return world
