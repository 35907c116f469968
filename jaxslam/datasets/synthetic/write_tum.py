"""Write a rendered recording to disk in the layout of the TUM RGB-D benchmark."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from jaxslam.datasets.synthetic.dataset import DEPTH_COUNTS_PER_M
from jaxslam.datasets.synthetic.recording_folder import (
    Progress,
    RenderedFrame,
    RenderedRecording,
    filling,
    write_frames,
    write_texts,
)
from jaxslam.errors import DatasetError
from jaxslam.io.timestamps import decimal_seconds
from jaxslam.trajectory import trajectory

_DIGITS = 6  # of a second, as in TUM RGB-D; the recording's times are whole microseconds
_TITLES = {
    "rgb": "color images",
    "depth": "depth maps",
    "mask": "masks of moving objects",
    "instance": "numbers of things and people",
}


def write_tum(
    dataset: RenderedRecording,
    folder: str | Path,
    progress: Progress | None = None,
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
    with filling(folder) as partial:
        write_frames(dataset, lambda _, frame: _images(partial, frame), progress)
        _write_lists(partial, dataset)
        write_texts(partial, texts)


def _images(folder: Path, frame: RenderedFrame) -> dict[Path, np.ndarray]:
    """Return the images of a frame by path."""
    counts = np.clip(np.round(frame.depth_m * DEPTH_COUNTS_PER_M), 0.0, 65535.0).astype(np.uint16)
    images = {"rgb": frame.rgb, "depth": counts, **frame.mask_images}
    name = f"{decimal_seconds(frame.timestamp_ns, _DIGITS)}.png"
    return {folder / kind / name: image for kind, image in images.items()}


def _write_lists(folder: Path, dataset: RenderedRecording) -> None:
    times = [decimal_seconds(int(timestamp_ns), _DIGITS) for timestamp_ns in dataset.timestamps_ns]
    for kind, title in _TITLES.items():
        if not (folder / kind).is_dir():
            continue
        rows = [f"{time} {kind}/{time}.png" for time in times]
        heading = [f"# {title}", f"# file: '{dataset.name}'", "# timestamp filename"]
        (folder / f"{kind}.txt").write_text("\n".join([*heading, *rows]) + "\n", encoding="utf-8")
    trajectory.write_tum(folder / "groundtruth.txt", dataset.ground_truth)
    dataset.camera.save(folder / "camera.yaml")
