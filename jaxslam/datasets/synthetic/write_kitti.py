"""Write a rendered stereo recording to disk in the layout of KITTI odometry.

Source: Geiger, Lenz and Urtasun, "Are we ready for Autonomous Driving? The KITTI Vision Benchmark Suite", CVPR 2012.
"""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from jaxslam.datasets.synthetic.recording_folder import (
    Progress,
    RenderedFrame,
    RenderedRecording,
    both_sides,
    check_is_pair,
    filling,
    write_frames,
    write_texts,
)
from jaxslam.io.timestamps import decimal_seconds
from jaxslam.sensors.camera import Camera
from jaxslam.trajectory import trajectory

KITTI_SEQUENCE = Path("sequences") / "00"
"""Folder of the sequence in the folder of the recording; `open_dataset` takes it."""

_POSES, _SIDES = Path("poses") / "00.txt", ("image_2", "image_3")


def write_kitti(
    dataset: RenderedRecording,
    folder: str | Path,
    progress: Progress | None = None,
    texts: Mapping[str, str] | None = None,
) -> None:
    """Write a stereo recording of which `open_dataset` reads `sequences/00`: the files of KITTI odometry, and masks.

    In `sequences/00/` there are color images (`image_2/`, `image_3/`), `calib.txt`, `times.txt` with seconds since the
    first frame, and `camera.yaml`, which holds the frame rate; and folders of masks with the names of the images
    (`mask/` with the numbers of what moves). `poses/00.txt` has the poses of the left camera in the world, which need
    not begin with the identity. The gray cameras 0 and 1 of the calibration are where the color cameras are.

    Frames are written to `<folder>.partial`, as `write_tum` does.

    Args:
        dataset: Recording of a stereo pair.
        folder: Folder to write to; it must not exist, or be empty.
        progress: Called after each frame with the number of frames written and to be written.
        texts: Contents of text files to write into `sequences/00`, by name.

    Raises:
        DatasetError: The folder is in use, a file cannot be written, or the recording is not of a stereo pair.
    """
    check_is_pair(dataset)
    with filling(folder) as partial:
        sequence = partial / KITTI_SEQUENCE
        write_frames(dataset, lambda index, frame: _images(sequence, index, frame), progress)
        (sequence / "calib.txt").write_text(_calibration(dataset.camera), encoding="utf-8")
        (sequence / "times.txt").write_text(_times(dataset.timestamps_ns), encoding="utf-8")
        dataset.camera.save(sequence / "camera.yaml")
        (partial / _POSES).parent.mkdir()
        trajectory.write_kitti(partial / _POSES, dataset.ground_truth)
        write_texts(sequence, texts)


def _images(sequence: Path, index: int, frame: RenderedFrame) -> dict[Path, np.ndarray]:
    """Return the images of a frame by path."""
    images = {**dict(zip(_SIDES, both_sides(frame), strict=True)), **frame.mask_images}
    return {sequence / kind / f"{index:06d}.png": image for kind, image in images.items()}


def _calibration(camera: Camera) -> str:
    """Return the projections `P0` to `P3`, of the left and the right camera in turn, and the place of no laser."""
    K = np.array([[camera.fx, 0, camera.cx, 0], [0, camera.fy, camera.cy, 0], [0, 0, 1, 0]])
    right = K.copy()
    right[0, 3] = -camera.fx * (camera.baseline_m or 0.0)
    matrices = {"P0": K, "P1": right, "P2": K, "P3": right, "Tr": np.eye(4)[:3]}
    rows = [f"{name}: " + " ".join(f"{x:.12e}" for x in matrix.ravel()) for name, matrix in matrices.items()]
    return "\n".join(rows) + "\n"


def _times(timestamps_ns: np.ndarray) -> str:
    """Return one line a frame: seconds since the first, with nine decimals."""
    return "".join(f"{decimal_seconds(since_ns)}\n" for since_ns in (timestamps_ns - timestamps_ns[0]).tolist())
