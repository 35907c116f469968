"""Recordings behind one protocol: `open_dataset(path)` recognises what a folder holds and opens it."""

import functools
import importlib
import pkgutil
from pathlib import Path

from jaxslam.camera import Camera, known_cameras
from jaxslam.datasets.protocol import Associated, Dataset, Fit, Loader, Unmatched
from jaxslam.datasets.stream import Subset, prefetch
from jaxslam.errors import CameraError, DatasetError, nearest

__all__ = [
    "Associated",
    "Dataset",
    "Loader",
    "Subset",
    "Unmatched",
    "dataset_kinds",
    "open_dataset",
    "prefetch",
]


def open_dataset(path: str | Path, kind: str = "auto", camera: Camera | str | Path | None = None) -> Dataset:
    """Open a recording.

    Args:
        path: Its folder.
        kind: One of `dataset_kinds()`, or `auto` to recognise it by its files and name.
        camera: A camera, the name of a known one or a camera file. `None` takes `camera.yaml` in the folder
            or, without one, the camera that the folder's name tells.

    Raises:
        DatasetError: If the folder is missing, of no known kind, incomplete or unreadable.
        CameraError: If the camera cannot be told or loaded.
    """
    folder = Path(path).expanduser().resolve()
    if not folder.is_dir():
        what = "a file (an archive must be unpacked first)" if folder.exists() else "nothing there"
        raise DatasetError(f"{path}: expected the folder of a recording, got {what}")
    loader = _loader(folder, kind)
    return loader.open(folder, _camera(folder, loader, camera))


def dataset_kinds() -> list[str]:
    """The kinds of recordings that can be opened."""
    return sorted(_loaders())


@functools.cache
def _loaders() -> dict[str, Loader]:
    modules = [module.name for module in pkgutil.iter_modules(__path__) if not module.ispkg]
    found = [getattr(importlib.import_module(f"{__name__}.{name}"), "LOADER", None) for name in modules]
    return {loader.kind: loader for loader in found if isinstance(loader, Loader)}


def _loader(folder: Path, kind: str) -> Loader:
    if kind != "auto":
        if kind not in _loaders():
            raise DatasetError(f"kind: expected 'auto' or a known one, got '{kind}'{nearest(kind, _loaders())}")
        return _loaders()[kind]
    best = max(_loaders().values(), key=lambda loader: loader.fit(folder))
    if best.fit(folder) is Fit.NO:
        raise DatasetError(
            f"{folder}: expected a recording of kind {' or '.join(dataset_kinds())} (rgb.txt and depth.txt;"
            " or calib.txt, times.txt, image_0 and image_1), got a folder without those files"
        )
    return best


def _camera(folder: Path, loader: Loader, camera: Camera | str | Path | None) -> Camera:
    if isinstance(camera, Camera):
        return camera
    if camera is not None:
        return Camera.load(camera)
    if (folder / "camera.yaml").is_file():
        return Camera.load(folder / "camera.yaml")
    if loader.camera is not None:
        return loader.camera(folder)
    name = loader.camera_name(folder)
    if name is None:
        raise CameraError(
            f"{folder.name}: its name does not tell the camera; give --camera with a camera file or one of "
            + ", ".join(known_cameras())
        )
    return Camera.load(name)
