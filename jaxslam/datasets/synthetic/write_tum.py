"""Write a rendered recording to disk in the layout of the TUM RGB-D benchmark."""

import shutil
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Protocol

import cv2
import numpy as np

from jaxslam.datasets.synthetic.dataset import DEPTH_COUNTS_PER_M
from jaxslam.errors import DatasetError
from jaxslam.io.timestamps import decimal_seconds
from jaxslam.sensors.camera import Camera
from jaxslam.trajectory import trajectory
from jaxslam.trajectory.trajectory import Trajectory

_DIGITS = 6  # of a second, as in TUM RGB-D; the recording's times are whole microseconds
_MASK_TITLES = {"mask": "masks of moving objects", "instance": "numbers of things and people"}


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


def write_tum(
    dataset: RenderedRecording,
    folder: str | Path,
    progress: Callable[[int, int], None] | None = None,
    texts: Mapping[str, str] | None = None,
) -> None:
    """Write a recording that `open_dataset` reads: the files of TUM RGB-D, and two things more.

    Beside `rgb/`, `depth/` (16 bits, 5000 a meter), their lists and `groundtruth.txt` there are folders of masks with
    their lists (`mask/` with the numbers of what moves), and `camera.yaml`.

    Frames are written to `<folder>.partial`, which becomes `folder` when everything is there: a folder of the wanted
    name is complete, and what an interrupted run has left is overwritten by the next.

    Args:
        dataset: Recording to write.
        folder: Folder to write to; it must not exist, or be empty.
        progress: Called after each frame with the number of frames written and to be written.
        texts: Contents of text files to write beside them, by name.

    Raises:
        DatasetError: The folder is in use, a file cannot be written, or it is of a stereo pair.
    """
    if dataset.camera.is_stereo:
        raise DatasetError(f"{dataset.name}: expected a camera with depth images, got a stereo pair (baseline_m)")
    folder = Path(folder).resolve()
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise DatasetError(f"{folder}: expected no such folder or an empty one, got one in use")
    partial = folder.with_name(folder.name + ".partial")
    try:
        shutil.rmtree(partial, ignore_errors=True)
        kinds = ["rgb", "depth"]
        for index in range(len(dataset)):
            kinds = _write_images(partial, dataset.render(index))
            if progress is not None:
                progress(index + 1, len(dataset))
        _write_lists(partial, dataset, kinds)
        for name, text in (texts or {}).items():
            (partial / name).write_text(text, encoding="utf-8")
        if folder.exists():
            folder.rmdir()
        partial.rename(folder)
    except OSError as problem:
        raise DatasetError(f"{partial}: cannot be written: {problem}") from problem


def _write_images(folder: Path, frame: RenderedFrame) -> list[str]:
    """Write the images of a frame, and return the names of their folders."""
    name = f"{decimal_seconds(frame.timestamp_ns, _DIGITS)}.png"
    counts = np.clip(np.round(frame.depth_m * DEPTH_COUNTS_PER_M), 0.0, 65535.0).astype(np.uint16)
    images = {"rgb": frame.rgb[..., ::-1], "depth": counts, **frame.mask_images}
    for kind, image in images.items():
        (folder / kind).mkdir(parents=True, exist_ok=True)
        if not cv2.imwrite(str(folder / kind / name), np.ascontiguousarray(image)):
            raise DatasetError(f"{folder / kind / name}: cannot be written")
    return list(images)


def _write_lists(folder: Path, dataset: RenderedRecording, kinds: list[str]) -> None:
    times = [decimal_seconds(int(timestamp_ns), _DIGITS) for timestamp_ns in dataset.timestamps_ns]
    titles = {"rgb": "color images", "depth": "depth maps", **_MASK_TITLES}
    for kind in kinds:
        rows = [f"{time} {kind}/{time}.png" for time in times]
        heading = [f"# {titles[kind]}", f"# file: '{dataset.name}'", "# timestamp filename"]
        (folder / f"{kind}.txt").write_text("\n".join([*heading, *rows]) + "\n", encoding="utf-8")
    trajectory.write_tum(folder / "groundtruth.txt", dataset.ground_truth)
    dataset.camera.save(folder / "camera.yaml")
