"""Unpacking an archive from the web: only files and folders, only inside the target, all of it or nothing."""

import gzip
import os
import shutil
import stat
import tarfile
import zipfile
import zlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import IO, TypeAlias

from jaxslam.errors import DatasetError

MAX_UNPACKED_BYTES = 64 * 10**9
"""What unpacks to more than this is taken for a bomb."""

_MAX_MEMBERS = 1_000_000
_CHUNK_BYTES = 1 << 20
_JUNK = "__MACOSX"
_DAMAGE = (tarfile.TarError, zipfile.BadZipFile, gzip.BadGzipFile, zlib.error, EOFError)

Progress: TypeAlias = Callable[[int, int], None]
"""Is told the bytes of the archive that are unpacked, and those there are."""


@dataclass(frozen=True)
class _Member:
    """One entry of an archive."""

    name: str
    size: int
    content: IO[bytes] | None
    """`None` for a folder."""
    read_bytes: int
    """How far the archive has been read where this entry begins."""


@dataclass
class _Budget:
    """What may still be unpacked."""

    whole: int
    left: int
    members: int = _MAX_MEMBERS

    def take(self, count: int) -> None:
        self.left -= count
        if self.left < 0:
            raise DatasetError(f"expected at most {self.whole / 1e9:g} GB when unpacked, got more")

    def take_member(self) -> None:
        self.members -= 1
        if self.members < 0:
            raise DatasetError(f"expected at most {_MAX_MEMBERS} files, got more")


def unpack(
    archive: str | os.PathLike[str],
    target: str | os.PathLike[str],
    *,
    holds: Sequence[str] = (),
    max_bytes: int = MAX_UNPACKED_BYTES,
    progress: Progress | None = None,
) -> None:
    """Unpack the one folder that an archive holds, and put it in its place once it is whole.

    All checksums of the archive are compared. What is unpacked grows in `.TARGET.unpacking` beside the target; nothing
    of it stays if it fails or is interrupted, and the next call removes what a killed one left. Nothing is done with
    owners and permissions. One process at a time for a target.

    Args:
        archive: A .tgz or .zip file, recognized by its content.
        target: What the folder becomes; must not be there yet. Folders above it are made.
        holds: Files that must be in the folder.
        max_bytes: Of all files when unpacked.
        progress: Called after each file.

    Raises:
        DatasetError: If the archive is damaged, too large when unpacked, holds anything but files and folders, or
            anything that would lie outside the target; if it is another one than expected; if it cannot be read, or
            the target not be written.
    """
    source, place = Path(archive), Path(target)
    growing = place.with_name(f".{place.name}.unpacking")
    if place.exists() or place.is_symlink():
        raise DatasetError(f"{place}: expected nothing there, to unpack {source.name} to")
    try:
        _remove(growing)
        growing.mkdir(parents=True)
        try:
            _extract(source, growing, _Budget(max_bytes, max_bytes), progress)
            os.replace(_folder_of_interest(growing, place.name, holds), place)
        finally:
            _remove(growing)
    except _DAMAGE as failure:
        raise DatasetError(f"{source}: damaged: {failure}") from failure
    except OSError as failure:
        raise DatasetError(f"{place}: cannot be unpacked: {failure}") from failure
    except DatasetError as failure:
        raise DatasetError(f"{source}: {failure}") from failure


def _remove(folder: Path) -> None:
    if folder.exists():
        shutil.rmtree(folder)


def _extract(source: Path, folder: Path, budget: _Budget, progress: Progress | None) -> None:
    total = source.stat().st_size
    if progress is not None:
        progress(0, total)
    for member in _members(source, budget):
        budget.take_member()
        place = _place(folder, member.name)
        if member.content is None:
            place.mkdir(parents=True, exist_ok=True)
        else:
            _copy(member, member.content, place, budget)
        if progress is not None:
            progress(member.read_bytes, total)
    if progress is not None:
        progress(total, total)


def _members(source: Path, budget: _Budget) -> Iterator[_Member]:
    with source.open("rb") as file:
        start = file.read(4)
        file.seek(0)
        if start.startswith(b"\x1f\x8b"):
            yield from _tar_members(file, budget)
        elif start.startswith(b"PK"):
            yield from _zip_members(file, budget)
        else:
            raise DatasetError("expected a .tgz or .zip archive, got something else")


def _tar_members(file: IO[bytes], budget: _Budget) -> Iterator[_Member]:
    with gzip.GzipFile(fileobj=file) as unzipped:
        with tarfile.open(fileobj=unzipped, mode="r|", bufsize=_CHUNK_BYTES) as archive:
            for entry in archive:
                if not (entry.isfile() or entry.isdir()):
                    raise DatasetError(f"expected files and folders only, got the link or device '{entry.name}'")
                content = archive.extractfile(entry) if entry.isfile() else None
                yield _Member(entry.name, entry.size, content, file.tell())
        # The checksum stands at the very end, behind what tar looks at.
        while rest := unzipped.read(_CHUNK_BYTES):
            budget.take(len(rest))


def _zip_members(file: IO[bytes], budget: _Budget) -> Iterator[_Member]:
    done = 0
    with zipfile.ZipFile(file) as archive:
        if sum(entry.file_size for entry in archive.infolist()) > budget.left:
            budget.take(budget.left + 1)
        for entry in archive.infolist():
            _check_zip_entry(entry)
            if entry.is_dir():
                yield _Member(entry.filename, 0, None, done)
            else:
                with archive.open(entry) as content:
                    yield _Member(entry.filename, entry.file_size, content, done)
            done += entry.compress_size


def _check_zip_entry(entry: zipfile.ZipInfo) -> None:
    kind = stat.S_IFMT(entry.external_attr >> 16)  # 0 where the archive was not made on a Unix
    if kind not in (0, stat.S_IFREG, stat.S_IFDIR):
        raise DatasetError(f"expected files and folders only, got the link or device '{entry.filename}'")
    if entry.flag_bits & 1:
        raise DatasetError(f"expected files without a password, got '{entry.filename}'")
    if entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise DatasetError(f"'{entry.filename}': expected the usual compression, got type {entry.compress_type}")


def _place(folder: Path, name: str) -> Path:
    """Where an entry goes; as no links are made, only its name could lead it elsewhere."""
    path, as_windows = PurePosixPath(name), PureWindowsPath(name)
    inside = not (path.is_absolute() or as_windows.drive or ".." in path.parts or "\\" in name or "\0" in name)
    if not inside:
        raise DatasetError(f"expected files inside one folder, got '{name}'")
    return folder / path


def _copy(member: _Member, content: IO[bytes], place: Path, budget: _Budget) -> None:
    budget.take(member.size)
    place.parent.mkdir(parents=True, exist_ok=True)
    with place.open("xb") as file:  # a second one of that name is refused
        shutil.copyfileobj(content, file, _CHUNK_BYTES)
    if (length := place.stat().st_size) != member.size:
        raise DatasetError(f"'{member.name}': expected {member.size} bytes, got {length}")


def _folder_of_interest(folder: Path, name: str, holds: Sequence[str]) -> Path:
    """The folder of that name, else the only one, else all of it."""
    entries = [entry for entry in folder.iterdir() if entry.name != _JUNK and not entry.name.startswith(".")]
    chosen = folder
    if (folder / name).is_dir():
        chosen = folder / name
    elif len(entries) == 1 and entries[0].is_dir():
        chosen = entries[0]
    missing = [file for file in holds if not (chosen / file).is_file()]
    if missing:
        raise DatasetError(f"expected a folder with {' and '.join(holds)}, got one without {' and '.join(missing)}")
    return chosen
