"""Public recordings: where they come from, under which license, and where they lie here."""

import difflib
import os
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, ClassVar, Literal

import platformdirs

from jaxslam.config.catalog import CatalogEntry, read_catalog
from jaxslam.config.validation import Range
from jaxslam.errors import DatasetError, JaxSlamError

_DEPTH = 3
_MARKS = ("rgb.txt", "times.txt", "mav0/cam0/data.csv", "pose_left.txt")
"""Files of which one is in every recording of the layouts of TUM, KITTI, EuRoC and TartanAir."""
_SHORTENED = ((re.compile(r"\Argbd_dataset_freiburg"), "fr"), (re.compile(r"\Argbd_bonn_"), "bonn_"))


@dataclass(frozen=True, kw_only=True)
class Recording(CatalogEntry):
    """A public recording. Its name is also that of its unpacked folder; `kitti_05` is KITTI's `sequences/05`.

    Attributes:
        dataset: Name of the dataset that the recording belongs to.
        kind: Name of the loader that opens the recording.
        typical_size: Size of the archives of the dataset in words, for recordings without `size_bytes`.
        frames: Number of frames of the whole recording: pairs of stereo images, or color images, of which a few have no
            depth image taken at the same time; `None` if unknown.

    Raises:
        DatasetError: If a field has the wrong type or cannot be right.
    """

    _error: ClassVar[type[JaxSlamError]] = DatasetError

    dataset: str
    kind: Literal["tum", "bonn", "kitti", "euroc"]
    typical_size: str = "-"
    frames: Annotated[int, Range(at_least=1)] | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.url is not None and not self.url.endswith((".tgz", ".zip")):
            raise DatasetError(f"url: expected .tgz or .zip at the end, got {self.url!r:.80}")

    @property
    def archive(self) -> str:
        """Name of its archive; empty if it has none of its own."""
        return "" if self.url is None else self.name + self.url[-len(".tgz") :]


def known_recordings(path: Path | None = None) -> dict[str, Recording]:
    """Read the catalog of recordings: recordings by name.

    Args:
        path: The file; by default `configs/recordings.yaml`.

    Raises:
        DatasetError: If the file is unreadable, or an entry is incomplete, has an unknown key or is listed twice.
    """
    return read_catalog(Recording, "recordings", path)


def known_recording(name: str) -> Recording:
    """The recording of that name.

    Raises:
        DatasetError: If there is none; it names the one that is meant, if it can tell.
    """
    known = known_recordings()
    if name not in known:
        raise DatasetError(f"expected the name of a known recording, got '{name}'{_meant(name, list(known))}")
    return known[name]


def recordings_dir() -> Path:
    """Return the folder of downloads: `recordings` in the user's cache folder for jaxslam."""
    return Path(platformdirs.user_cache_dir("jaxslam", appauthor=False)) / "recordings"


def find_recording(name: str, root: str | os.PathLike[str] | None = None) -> Path | None:
    """The folder of a recording on this machine, or `None`.

    Args:
        name: Name of its folder, listed or not; `kitti_05` is `sequences/05`.
        root: Folder to search first. Then come the folder that `JAXSLAM_DATA` names and `recordings_dir()`; each is
            searched three levels deep.

    Raises:
        DatasetError: If `root` or `JAXSLAM_DATA` is no folder.
    """
    return found_recordings(root).get(name)


def found_recordings(root: str | os.PathLike[str] | None = None) -> dict[str, Path]:
    """The folders of all recordings on this machine, by name, known or not; of two the one `find_recording` gives.

    Raises:
        DatasetError: If `root` or `JAXSLAM_DATA` is no folder.
    """
    found: dict[str, Path] = {}
    for place in _places(root):
        for folder in _recordings_below(place):
            found.setdefault(name_of(folder), folder)
    return found


def _meant(name: str, known: list[str]) -> str:
    """A hint for a misspelt or shortened name such as `fr3_walking_xyz` or `crowd2`."""
    shortened = {_short(full): full for full in known}
    parts = {short.partition("_")[2]: full for short, full in shortened.items()}
    given = _short(name.lower().replace("/", "_"))
    for choices in (shortened, parts):
        close = difflib.get_close_matches(given, choices, n=1, cutoff=0.75)
        if close:
            return f" (did you mean '{choices[close[0]]}'?)"
    return "; jaxslam data list prints them"


def _short(name: str) -> str:
    for pattern, by in _SHORTENED:
        name = pattern.sub(by, name)
    return name


def _places(root: str | os.PathLike[str] | None) -> Iterator[Path]:
    named = {"root": None if root is None else os.fspath(root), "JAXSLAM_DATA": os.environ.get("JAXSLAM_DATA")}
    for what, folder in named.items():
        if folder:
            if not Path(folder).is_dir():
                raise DatasetError(f"{what}: expected a folder, got '{folder}'")
            yield Path(folder)
    if recordings_dir().is_dir():
        yield recordings_dir()


def _recordings_below(root: Path) -> Iterator[Path]:
    """Those nearest to the root first; what lies inside a recording is not looked at."""
    level = [root]
    for _ in range(_DEPTH):
        below = [folder for parent in level for folder in _subfolders(parent)]
        level = []
        for folder in below:
            if any(os.path.isfile(folder / mark) for mark in _MARKS):
                yield folder
            else:
                level.append(folder)


def _subfolders(folder: Path) -> list[Path]:
    try:
        with os.scandir(folder) as entries:
            names = sorted(entry.name for entry in entries if not entry.name.startswith("."))
    except (PermissionError, FileNotFoundError):  # what is somebody else's, or just went away, holds nothing to find
        return []
    return [folder / name for name in names if os.path.isdir(folder / name)]


def name_of(folder: Path) -> str:
    """Name a recording by its folder; KITTI's `sequences/05` is `kitti_05`."""
    return f"kitti_{folder.name}" if folder.parent.name == "sequences" else folder.name
