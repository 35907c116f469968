"""Write a rendered recording to disk in the layout that suits it, or in the one that is asked for."""

from collections.abc import Mapping
from pathlib import Path
from typing import Literal, TypeAlias

from jaxslam.datasets.synthetic.recording_folder import Progress, RenderedRecording, imu_of
from jaxslam.datasets.synthetic.write_euroc import write_euroc
from jaxslam.datasets.synthetic.write_kitti import KITTI_SEQUENCE, write_kitti
from jaxslam.datasets.synthetic.write_tum import write_tum

Layout: TypeAlias = Literal["tum", "euroc", "kitti"]

_WRITERS = {"tum": write_tum, "euroc": write_euroc, "kitti": write_kitti}


def write_recording(
    dataset: RenderedRecording,
    folder: Path,
    layout: Layout | None = None,
    progress: Progress | None = None,
    texts: Mapping[str, str] | None = None,
) -> Path:
    """Write a recording, see `write_tum`, `write_euroc` and `write_kitti`.

    Args:
        dataset: Recording to write.
        folder: Folder to write to; it must not exist, or be empty.
        layout: Layout of the files; `None` for `default_layout`.
        progress: Called after each frame with the number of frames written and to be written.
        texts: Contents of text files to write beside them, by name.

    Returns:
        The folder that `open_dataset` takes.

    Raises:
        DatasetError: The folder is in use, a file cannot be written, or the layout does not suit the camera.
    """
    chosen = layout or default_layout(dataset)
    _WRITERS[chosen](dataset, folder, progress, texts)
    return folder / KITTI_SEQUENCE if chosen == "kitti" else folder


def default_layout(dataset: RenderedRecording) -> Layout:
    """Return tum for a depth camera, euroc for a stereo pair with an IMU, and kitti for one without."""
    if not dataset.camera.is_stereo:
        return "tum"
    return "kitti" if imu_of(dataset) is None else "euroc"
