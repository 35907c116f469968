"""Unpack archives from the web: only files and folders, only inside the target, all of them or none."""

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
"""Size limit of an unpacked archive; a larger one is taken for a decompression bomb."""

_MAX_MEMBERS = 1_000_000
_CHUNK_BYTES = 1 << 20
_JUNK = "__MACOSX"
_DAMAGE = (tarfile.TarError, zipfile.BadZipFile, gzip.BadGzipFile, zlib.error, EOFError)

Progress: TypeAlias = Callable[[int, int], None]
"""Function that is called with the bytes of the archive that are unpacked, and the bytes of the whole archive."""


@dataclass
class _Budget:
    """Limits of what may still be unpacked."""

    whole: int
    """Bytes that the archive may unpack to."""
    left: int
    """Bytes that may still be unpacked."""
    members: int = _MAX_MEMBERS
    """Files and folders that may still be unpacked."""

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
    """Unpack the one folder that an archive holds, and move it to the target once it is complete.

    All checksums of the archive are compared. The files are unpacked into `.TARGET.unpacking` beside the target; that
    folder is removed if unpacking fails or is interrupted, and the next call removes one that a killed process left.
    Owners are ignored, and so are permissions other than those that tarfile's `data` filter keeps. Only one process may
    unpack to a target at a time.

    Args:
        archive: A .tgz or .zip file, recognized by its content.
        target: New path of the folder, which must not exist yet. Its parents are created.
        holds: Names of files that must be in the folder.
        max_bytes: Size limit of all unpacked files together, in bytes.
        progress: Function that is called after each file.

    Raises:
        DatasetError: If the archive is damaged, too large when unpacked, holds anything other than files and folders,
            holds a path outside the target, or is not the expected archive; if it cannot be read, or the target cannot
            be written.
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
    for read_bytes in _extracted(source, folder, budget):
        if progress is not None:
            progress(read_bytes, total)
    if progress is not None:
        progress(total, total)


def _extracted(source: Path, folder: Path, budget: _Budget) -> Iterator[int]:
    """Extract all members; after each, yield how many bytes of the archive have been read."""
    with source.open("rb") as file:
        start = file.read(4)
        file.seek(0)
        if start.startswith(b"\x1f\x8b"):
            yield from _extracted_tar(file, folder, budget)
        elif start.startswith(b"PK"):
            yield from _extracted_zip(file, folder, budget)
        else:
            raise DatasetError("expected a .tgz or .zip archive, got something else")


def _extracted_tar(file: IO[bytes], folder: Path, budget: _Budget) -> Iterator[int]:
    with gzip.GzipFile(fileobj=file) as unzipped:
        with tarfile.open(fileobj=unzipped, mode="r|", bufsize=_CHUNK_BYTES) as archive:
            for entry in archive:
                if not (entry.isfile() or entry.isdir()):
                    raise DatasetError(f"expected files and folders only, got the link or device '{entry.name}'")
                _check_member(folder, entry.name, entry.size, budget, is_folder=entry.isdir())
                archive.extract(entry, folder, filter="data")
                yield file.tell()
        # The checksum is at the very end of the file, behind what tarfile reads.
        while rest := unzipped.read(_CHUNK_BYTES):
            budget.take(len(rest))


def _extracted_zip(file: IO[bytes], folder: Path, budget: _Budget) -> Iterator[int]:
    done = 0
    with zipfile.ZipFile(file) as archive:
        if sum(entry.file_size for entry in archive.infolist()) > budget.left:
            budget.take(budget.left + 1)
        for entry in archive.infolist():
            _check_zip_entry(entry)
            _check_member(folder, entry.filename, entry.file_size, budget, is_folder=entry.is_dir())
            archive.extract(entry, folder)
            done += entry.compress_size
            yield done


def _check_zip_entry(entry: zipfile.ZipInfo) -> None:
    kind = stat.S_IFMT(entry.external_attr >> 16)  # 0 where the archive was not made on a Unix
    if kind not in (0, stat.S_IFREG, stat.S_IFDIR):
        raise DatasetError(f"expected files and folders only, got the link or device '{entry.filename}'")
    if entry.flag_bits & 1:
        raise DatasetError(f"expected files without a password, got '{entry.filename}'")
    if entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise DatasetError(f"'{entry.filename}': expected the usual compression, got type {entry.compress_type}")


def _check_member(folder: Path, name: str, size: int, budget: _Budget, *, is_folder: bool) -> None:
    """Refuse a member that is too large, outside the folder or already unpacked.

    No links are made, so that only the name of a member could place it outside the folder. tarfile and zipfile would
    change such a name to one inside, and would overwrite the earlier of two files.
    """
    budget.take_member()
    path, as_windows = PurePosixPath(name), PureWindowsPath(name)
    if path.is_absolute() or as_windows.drive or ".." in path.parts or "\\" in name or "\0" in name:
        raise DatasetError(f"expected files inside one folder, got '{name}'")
    if not is_folder and (folder / path).exists():
        raise DatasetError(f"expected every file once, got '{name}' twice")
    budget.take(size)


def _folder_of_interest(folder: Path, name: str, holds: Sequence[str]) -> Path:
    """Choose the folder with the given name, or else the only folder, or else the whole content."""
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
