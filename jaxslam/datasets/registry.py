"""Opening of recordings: recognize what kind a folder holds, and choose its camera."""

import functools
import importlib
import pkgutil
from pathlib import Path

from jaxslam.datasets import loaders
from jaxslam.datasets.protocol import Dataset, Fit, Loader
from jaxslam.errors import CameraError, DatasetError, nearest
from jaxslam.sensors.camera import Camera, known_cameras
from jaxslam.sensors.rectification import RectifiedPair, load_camera

_CAMERA_FILE = "camera.yaml"


def open_dataset(
    path: str | Path, kind: str = "auto", camera: Camera | RectifiedPair | str | Path | None = None
) -> Dataset:
    """Open a recording.

    Args:
        path: Folder of the recording.
        kind: One of `dataset_kinds()`, or `auto` to recognize it by its files and name.
        camera: A camera, the name of a known one or a camera file; for raw images of two cameras, a rectified pair or
            its file. `None` takes `camera.yaml` in the folder or, without one, the camera that the folder's name or
            calibration tells.

    Raises:
        DatasetError: If the folder is missing, of no known kind, incomplete or unreadable.
        CameraError: If the camera is unknown or cannot be loaded.
    """
    folder = _folder(path)
    loader = _loader(folder, kind)
    chosen = _camera(folder, loader, camera)
    if isinstance(chosen, RectifiedPair) and not loader.rectifies:
        raise CameraError(
            f"rig '{chosen.rig.name}': expected one camera, as recordings of kind {loader.kind} are rectified, got two"
        )
    return loader.open(folder, chosen)


def layout_of(path: str | Path, kind: str = "auto") -> Loader:
    """Return the loader that opens a folder.

    Args:
        path: Folder of the recording.
        kind: One of `dataset_kinds()`, or `auto` to recognize it by its files and name.

    Raises:
        DatasetError: If the folder is missing, or of no known kind.
    """
    return _loader(_folder(path), kind)


def calibration_in(path: str | Path, kind: str = "auto") -> Camera | RectifiedPair | None:
    """Return the camera that a file in a folder describes; `None` if there is only the name of the folder to go by.

    Args:
        path: Folder of the recording.
        kind: One of `dataset_kinds()`, or `auto` to recognize it by its files and name.

    Raises:
        DatasetError: If the folder is missing, or of no known kind.
        CameraError: If its file cannot be loaded.
    """
    folder = _folder(path)
    if (folder / _CAMERA_FILE).is_file():
        return load_camera(folder / _CAMERA_FILE)
    loader = _loader(folder, kind)
    return loader.camera(folder) if loader.reads_calibration else None


def dataset_kinds() -> list[str]:
    """Return the kinds of recordings that can be opened."""
    return sorted(_loaders())


@functools.cache
def _loaders() -> dict[str, Loader]:
    modules = [module.name for module in pkgutil.iter_modules(loaders.__path__)]
    found = [getattr(importlib.import_module(f"{loaders.__name__}.{name}"), "LOADER", None) for name in modules]
    return {loader.kind: loader for loader in found if isinstance(loader, Loader)}


def _folder(path: str | Path) -> Path:
    folder = Path(path).expanduser().resolve()
    if not folder.is_dir():
        what = "a file (an archive must be unpacked first)" if folder.exists() else "nothing there"
        raise DatasetError(f"{path}: expected the folder of a recording, got {what}")
    return folder


def _loader(folder: Path, kind: str) -> Loader:
    if kind != "auto":
        if kind not in _loaders():
            raise DatasetError(f"kind: expected 'auto' or a known one, got '{kind}'{nearest(kind, _loaders())}")
        return _loaders()[kind]
    best = max(_loaders().values(), key=lambda loader: loader.fit(folder))
    if best.fit(folder) is Fit.NO:
        _check_complete(folder)
        files = "; ".join(dict.fromkeys(loader.files for loader in _loaders().values() if loader.files))
        raise DatasetError(
            f"{folder}: expected a recording of kind {' or '.join(dataset_kinds())} ({files}),"
            f" got a folder without those files{_hint_of_recording_in(folder)}"
        )
    return best


def _check_complete(folder: Path) -> None:
    """Refuse a folder that seems to be a recording from which a part is missing.

    Raises:
        DatasetError: If there is at least half of the parts of a layout, but not all.
    """
    for loader in _loaders().values():
        there = [part for part in loader.parts if (folder / part).exists()]
        absent = [part for part in loader.parts if part not in there]
        if absent and 2 * len(there) >= len(loader.parts):
            raise DatasetError(f"{folder / absent[0]}: expected it beside {there[0]}, got none")


def _hint_of_recording_in(folder: Path) -> str:
    """Name a recording in a folder or in its folders; empty if there is none."""
    for pattern in ("*", "*/*"):
        for inner in sorted(path for path in folder.glob(pattern) if path.is_dir()):
            if max(loader.fit(inner) for loader in _loaders().values()) >= Fit.LAYOUT:
                return f"; a recording in it is {inner.relative_to(folder)}"
    return ""


def _camera(folder: Path, loader: Loader, camera: Camera | RectifiedPair | str | Path | None) -> Camera | RectifiedPair:
    if isinstance(camera, Camera | RectifiedPair):
        return camera
    if camera is not None:
        return load_camera(camera)
    if (folder / _CAMERA_FILE).is_file():
        return load_camera(folder / _CAMERA_FILE)
    told = loader.camera(folder)
    if told is None:
        raise CameraError(
            f"{folder.name}: its name does not tell the camera; give --camera with a camera file or one of "
            + ", ".join(known_cameras())
        )
    return told
