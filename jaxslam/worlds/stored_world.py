"""A recording of a world whose frames are kept in the user's cache."""

import hashlib
import json
import logging
import os
import shutil
from collections.abc import Iterable
from dataclasses import asdict
from pathlib import Path

import platformdirs

from jaxslam.datasets.synthetic.frame_files import FrameFiles, arrays_of
from jaxslam.errors import ConfigError, DatasetError
from jaxslam.runtime.machine import machine
from jaxslam.runtime.trace_cache import sources_hash
from jaxslam.worlds.data_paths import data_path
from jaxslam.worlds.description import World
from jaxslam.worlds.library import with_catalog, with_places
from jaxslam.worlds.recording import WorldFrame, WorldRecording

_log = logging.getLogger(__name__)

LIMIT_BYTES = 4 << 30
"""Default size of the cache: some 1000 frames of 640x480 pixels."""


def worlds_dir() -> Path:
    """Return the default folder of rendered frames: `worlds` in the user's cache folder for jaxslam."""
    return Path(platformdirs.user_cache_dir("jaxslam", appauthor=False)) / "worlds"


class StoredWorld(WorldRecording):
    """The same frames as `WorldRecording`, each rendered once on a machine.

    Frames of a world are known by its description, the files that it names, the sources of jaxslam, the versions of its
    libraries and the processor. Where the cache is full, the worlds that have not been opened for the longest time
    leave it; frames for which there still is no room are rendered every time. A damaged file is rendered again.
    """

    def __init__(
        self, world: World | str | Path, folder: str | Path | None = None, limit_bytes: int = LIMIT_BYTES
    ) -> None:
        """Build a world; the errors are those of `WorldRecording`.

        Args:
            world: A world, the name of one that comes with jaxslam, or a YAML file.
            folder: Folder of the cache; `None` for `worlds_dir()`.
            limit_bytes: Size that the cache may have.
        """
        super().__init__(world)
        self._cache, self._limit_bytes = worlds_dir() if folder is None else Path(folder), limit_bytes
        key = frames_key(self.world)
        self._files = None if key is None else FrameFiles(self._cache / key)
        if self._files is not None and self._files.folder.is_dir():
            self._files.folder.touch()

    def render(self, index: int) -> WorldFrame:
        """Frame `index` with its ground truth.

        Raises:
            IndexError: If there is no such frame.
        """
        index = range(len(self))[index]
        arrays = None if self._files is None else self._files.read(index)
        if arrays is not None:
            return WorldFrame(int(self.timestamps_ns[index]), **arrays, imu=self._imu_of(index))
        frame = super().render(index)
        self._keep(index, frame)
        return frame

    def render_all(self, indices: Iterable[int] | None = None) -> None:
        """Render those of some frames, or of all, that are not there yet."""
        for index in range(len(self)) if indices is None else indices:
            if self._files is not None and not self._files.has(index):
                self.render(index)

    def _keep(self, index: int, frame: WorldFrame) -> None:
        if self._files is None:
            return
        arrays = arrays_of(frame)
        size = sum(array.nbytes for array in arrays.values())
        try:
            if _make_room(self._cache, self._files.folder, size, self._limit_bytes):
                _sizes[self._cache] += self._files.write(index, arrays)
        except (DatasetError, OSError) as problem:
            _log.warning("frames are not kept, and rendered every time: %s", problem)
            self._files = None


_sizes: dict[Path, int] = {}
"""Sizes of caches, as far as this process knows."""


def _make_room(cache: Path, own: Path, size: int, limit_bytes: int) -> bool:
    """Remove other worlds from a full cache, those first that were opened longest ago; tells whether there is room."""
    if cache not in _sizes:
        _sizes[cache] = _size(cache)
    if _sizes[cache] + size <= limit_bytes:
        return True
    others = sorted((folder for folder in cache.iterdir() if folder != own), key=lambda folder: folder.stat().st_mtime)
    for folder in others:
        shutil.rmtree(folder, ignore_errors=True)  # another process may do the same
        _sizes[cache] = _size(cache)
        if _sizes[cache] + size <= limit_bytes:
            return True
    return False


def _size(folder: Path) -> int:
    if not folder.is_dir():
        return 0
    total = 0
    for file in folder.rglob("*.npz"):
        try:
            total += file.stat().st_size
        except FileNotFoundError:
            continue  # removed by another process
    return total


def frames_key(world: World) -> str | None:
    """Return the name under which the frames of a world are kept; `None` if sources changed after they were loaded.

    Raises:
        ConfigError: A variable in the path of a file is not set.
        DatasetError: A file that the world names cannot be read.
    """
    sources = sources_hash()
    if sources is None:
        return None
    here = {name: value for name, value in machine().items() if name in {"versions", "cpu", "vectors"}}
    here["XLA_FLAGS"] = os.environ.get("XLA_FLAGS")
    text = json.dumps([sources, here, description_hash(world)], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:32]


def description_hash(world: World) -> str:
    """Hash the description of a world, with all that it takes from others, and the files that it names.

    Raises:
        ConfigError: A variable in the path of a file is not set.
        DatasetError: A file cannot be read.
    """
    # What is beside roads depends on their order.
    whole = asdict(with_catalog(with_places(world)))
    files = [_content(data_path(path, Path())) for path in _files_of(world)]
    return hashlib.sha256(json.dumps([whole, list(whole["roads"]), files], sort_keys=True).encode()).hexdigest()


def why_not_here(world: World) -> str | None:
    """Explain why a world cannot be rendered on this machine; `None` if all files that it names are there."""
    for path in _files_of(world):
        try:
            file = data_path(path, Path())
        except ConfigError as problem:
            return str(problem)
        if not file.exists():
            return f"{file}: not there"
    return None


def _files_of(world: World) -> list[str]:
    imu, people = world.imu, world.real_people
    named = [world.way.file]
    named += [] if imu is None else [imu.file, imu.sheet]
    named += [] if people is None else [people.recording, people.network]
    return [path for path in named if path is not None]


def _content(path: Path) -> str:
    """Hash of a file; names, sizes and times of the files in a folder."""
    try:
        if path.is_dir():
            found = sorted((str(file.relative_to(path)), file.stat()) for file in path.rglob("*") if file.is_file())
            return json.dumps([(name, stat.st_size, stat.st_mtime_ns) for name, stat in found])
        return hashlib.sha256(path.read_bytes()).hexdigest()
    except OSError as problem:
        raise DatasetError(f"{path}: cannot be read: {problem.strerror}") from None
