"""Public recordings: where they come from, under which license, and where they lie here."""

import difflib
import os
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import platformdirs

from jaxslam.config.loading import configs_dir
from jaxslam.config.validation import Range, ValidatedConfig, field_hints
from jaxslam.errors import DatasetError, JaxSlamError
from jaxslam.io.yaml_files import check_keys, read_yaml

_DEPTH = 3
_NEEDED = ("dataset", "kind", "license", "page", "about")
_MARKS = ("rgb.txt", "times.txt", "mav0/cam0/data.csv", "pose_left.txt")
"""Files of which one is in every recording of the layouts of TUM, KITTI, EuRoC and TartanAir."""
_SHORTENED = ((re.compile(r"\Argbd_dataset_freiburg"), "fr"), (re.compile(r"\Argbd_bonn_"), "bonn_"))
_NAME = re.compile(r"[a-z0-9_]+\Z")
_SHA256 = re.compile(r"[0-9a-f]{64}\Z")


@dataclass(frozen=True)
class Recording(ValidatedConfig):
    """A public recording.

    Attributes:
        name: What commands call it, and the name of its folder when unpacked (KITTI's `kitti_05`: `sequences/05`).
        dataset: What it is part of.
        kind: Which loader opens it.
        license: As its page words it.
        page: Who made it.
        about: What is to be seen.
        url: Where its archive is published, .tgz or .zip; `None` if it cannot be had alone.
        size_bytes: Of that archive, if known.
        sha256: Of that archive, if known.
        typical_size: Of the archives of the dataset, in words, where the size of this one is not known.
        how: How to come by it, where there is no `url`.
        frames: How many frames the whole recording has, if that is known: its pairs of images, or its color images,
            of which a few have no depth image taken at the same time.

    Raises:
        DatasetError: If a field has the wrong type or cannot be right.
    """

    _error: ClassVar[type[JaxSlamError]] = DatasetError

    name: str
    dataset: str
    kind: Literal["tum", "bonn", "kitti"]
    license: str
    page: str
    about: str
    url: str | None = None
    size_bytes: Annotated[int, Range(above=0)] | None = None
    sha256: str | None = None
    typical_size: str = "-"
    how: str = ""
    frames: Annotated[int, Range(at_least=1)] | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if not _NAME.match(self.name):
            raise DatasetError(f"name: expected small letters, digits and _, got {self.name!r:.80}")
        if self.url is None and not self.how:
            raise DatasetError("url: expected an address, or `how` to come by it, got neither")
        if self.url is not None and not (self.url.startswith("http") and self.url.endswith((".tgz", ".zip"))):
            raise DatasetError(f"url: expected http, and .tgz or .zip at the end, got {self.url!r:.80}")
        if self.sha256 is not None and not _SHA256.match(self.sha256):
            raise DatasetError(f"sha256: expected 64 small hexadecimal digits, got {self.sha256!r:.80}")

    @property
    def archive(self) -> str:
        """Name of its archive; empty if it has none of its own."""
        return "" if self.url is None else self.name + self.url[-len(".tgz") :]


def known_recordings(path: Path | None = None) -> dict[str, Recording]:
    """The catalog, by name.

    Args:
        path: The file; the packaged one if not given.

    Raises:
        DatasetError: If it is unreadable, or an entry is incomplete, has an unknown key or stands twice.
    """
    path = path or configs_dir() / "recordings.yaml"
    groups = read_yaml(path, DatasetError)
    if not isinstance(groups, list):
        raise DatasetError(f"{path}: expected a list of datasets, got {type(groups).__name__}")
    known: dict[str, Recording] = {}
    for number, group in enumerate(groups, 1):
        for recording in _of_group(group, f"{path}: dataset {number}"):
            if recording.name in known:
                raise DatasetError(f"{path}: {recording.name}: stands twice")
            known[recording.name] = recording
    return known


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
    """Where downloads go: `recordings` in the user's cache folder for jaxslam."""
    return Path(platformdirs.user_cache_dir("jaxslam", appauthor=False)) / "recordings"


def find_recording(name: str, root: str | os.PathLike[str] | None = None) -> Path | None:
    """The folder of a recording on this machine, or `None`.

    Args:
        name: Of its folder, known or not; `kitti_05` is `sequences/05`.
        root: Where to look first. Then come the folder that `JAXSLAM_DATA` names and `recordings_dir()`; each is looked
            through three levels deep.

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


def _of_group(group: object, where: str) -> Iterator[Recording]:
    shared = _mapping(group, where)
    entries = _mapping(shared.pop("recordings", None), f"{where}: recordings")
    for name, entry in entries.items():
        fields: dict[str, Any] = shared | _mapping(entry, f"{where}: {name}") | {"name": name}
        check_keys(fields, field_hints(Recording), _NEEDED, f"{where}: {name}", DatasetError)
        if isinstance(fields.get("url"), str):
            fields["url"] = fields["url"].replace("{name}", name)
        try:
            yield Recording(**fields)
        except DatasetError as problem:
            raise DatasetError(f"{where}: {name}: {problem}") from None


def _mapping(value: object, where: str) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise DatasetError(f"{where}: expected `key: value` lines, got {type(value).__name__}")
    return {str(key): content for key, content in value.items()}


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
    """What a recording is called: by its folder, and KITTI's `sequences/05` is `kitti_05`."""
    return f"kitti_{folder.name}" if folder.parent.name == "sequences" else folder.name
