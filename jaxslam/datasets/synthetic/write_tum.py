"""Write a synthetic recording to disk in the layout of the TUM RGB-D benchmark."""

import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

from jaxslam.datasets.synthetic.dataset import DEPTH_COUNTS_PER_M, SyntheticDataset, SyntheticFrame
from jaxslam.errors import DatasetError
from jaxslam.io.timestamps import decimal_seconds
from jaxslam.trajectory import trajectory

_DIGITS = 6  # of a second, as in TUM RGB-D; the recording's times are whole microseconds


def write_tum(
    dataset: SyntheticDataset, folder: str | Path, progress: Callable[[int, int], None] | None = None
) -> None:
    """Write a recording that `open_dataset` reads: the files of TUM RGB-D, and two things more.

    Beside `rgb/`, `depth/` (16 bits, 5000 a meter), their lists and `groundtruth.txt` there are `mask/` with the
    numbers of the actors and its list, and `camera.yaml`.

    Frames are written to `<folder>.partial`, which becomes `folder` when everything is there: a folder of the wanted
    name is complete, and what an interrupted run has left is overwritten by the next.

    Args:
        dataset: Recording to write.
        folder: Folder to write to; it must not exist, or be empty.
        progress: Called after each frame with the number of frames written and to be written.

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
        for name in ("rgb", "depth", "mask"):
            (partial / name).mkdir(parents=True)
        for index in range(len(dataset)):
            _write_images(partial, dataset.render(index))
            if progress is not None:
                progress(index + 1, len(dataset))
        _write_lists(partial, dataset)
        if folder.exists():
            folder.rmdir()
        partial.rename(folder)
    except OSError as problem:
        raise DatasetError(f"{partial}: cannot be written: {problem}") from problem


def _write_images(folder: Path, frame: SyntheticFrame) -> None:
    name = f"{decimal_seconds(frame.timestamp_ns, _DIGITS)}.png"
    counts = np.clip(np.round(frame.depth_m * DEPTH_COUNTS_PER_M), 0.0, 65535.0).astype(np.uint16)
    images = {"rgb": frame.rgb[..., ::-1], "depth": counts, "mask": frame.instance_mask.astype(np.uint8)}
    for kind, image in images.items():
        if not cv2.imwrite(str(folder / kind / name), np.ascontiguousarray(image)):
            raise DatasetError(f"{folder / kind / name}: cannot be written")


def _write_lists(folder: Path, dataset: SyntheticDataset) -> None:
    times = [decimal_seconds(int(timestamp_ns), _DIGITS) for timestamp_ns in dataset.timestamps_ns]
    for kind, title in (("rgb", "color images"), ("depth", "depth maps"), ("mask", "masks of moving objects")):
        rows = [f"{time} {kind}/{time}.png" for time in times]
        heading = [f"# {title}", f"# file: '{dataset.name}'", "# timestamp filename"]
        (folder / f"{kind}.txt").write_text("\n".join([*heading, *rows]) + "\n", encoding="utf-8")
    trajectory.write_tum(folder / "groundtruth.txt", dataset.ground_truth)
    dataset.camera.save(folder / "camera.yaml")
