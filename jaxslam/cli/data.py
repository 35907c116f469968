"""`jaxslam data list` and `get`: the public recordings, and how one comes onto this machine."""

import shlex
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from jaxslam.cli.console import download_bar, make_table, plain_console, print_json
from jaxslam.cli.fetch import fetch
from jaxslam.cli.shared_options import WithJson
from jaxslam.datasets.catalog import (
    Recording,
    find_recording,
    found_recordings,
    known_recording,
    known_recordings,
    recordings_dir,
)
from jaxslam.errors import DatasetError
from jaxslam.io.archive import unpack
from jaxslam.io.download import sha256_of

_UNPACKED_PER_ARCHIVE = 1.2
"""Images hardly get smaller in an archive: two of TUM unpack to 1.07 and 1.08 times its size."""


@dataclass(frozen=True)
class ListRecordings(WithJson):
    """Options of `jaxslam data list`."""

    missing: bool = False
    """Only those that are not on this machine, with their addresses."""

    def main(self) -> None:
        """Run the command."""
        found, known = found_recordings(), known_recordings()
        shown = [recording for recording in known.values() if not (self.missing and recording.name in found)]
        if self.json:
            print_json([_listed(recording, found.get(recording.name)) for recording in shown])
            return
        for dataset in dict.fromkeys(recording.dataset for recording in shown):
            _print_dataset([recording for recording in shown if recording.dataset == dataset], found, urls=self.missing)
        here = sum(name in found for name in known)
        plain_console.print(f"{here} of {len(known)} are on this machine. To download one: jaxslam data get NAME")
        plain_console.print(f"Downloads go to {recordings_dir()}; a folder named by JAXSLAM_DATA is looked at first.")


@dataclass(frozen=True)
class GetRecording:
    """Options of `jaxslam data get`."""

    name: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="NAME")]
    """Name of a known recording, as `data list` prints it."""
    out: Path | None = None
    """Folder to put it into; the user's cache folder if not given."""
    keep_archive: bool = False
    """Leave the archive beside it."""

    def main(self) -> None:
        """Run the command."""
        recording = known_recording(self.name)
        root = self.out if self.out is not None and self.out.is_dir() else None
        if (found := find_recording(recording.name, root)) is not None:
            plain_console.print(f"{recording.name} is on this machine: {found}")
            _print_next(recording, found)
            return
        if recording.url is None:
            raise DatasetError(f"{recording.name} cannot be downloaded alone; {recording.how}. See {recording.page}")
        folder = self.out or recordings_dir()
        target, archive = folder / recording.name, folder / recording.archive
        plain_console.print(f"{recording.dataset}, license: {recording.license}, see {recording.page}")
        _fetch_and_unpack(recording, recording.url, archive, target)
        if not self.keep_archive:
            _delete(archive)
        plain_console.print(f"{recording.name}: {target}")
        if self.keep_archive:
            plain_console.print(f"Archive: {archive}")
        _print_next(recording, target)


def _listed(recording: Recording, folder: Path | None) -> dict[str, Any]:
    """A known recording for `--json`."""
    return {**asdict(recording), "here": None if folder is None else str(folder)}


def _print_dataset(shown: Sequence[Recording], found: Mapping[str, Path], *, urls: bool) -> None:
    """Print the recordings of one dataset, and in lines of their own, to be copied, where they are or come from."""
    licenses = " or ".join(dict.fromkeys(recording.license for recording in shown))
    pages = " or ".join(dict.fromkeys(recording.page for recording in shown))
    table = make_table(f"{shown[0].dataset}, license: {licenses}, see {pages}", "name", "size", "here", left=3)
    for recording in shown:
        table.add_row(recording.name, _size(recording), "yes" if recording.name in found else "no")
    plain_console.print(table)
    for recording in shown:
        if urls:
            plain_console.print(f"{recording.name}: {recording.url or recording.how}")
        elif recording.name in found:
            plain_console.print(f"{recording.name}: {found[recording.name]}")


def _size(recording: Recording) -> str:
    return recording.typical_size if recording.size_bytes is None else f"{recording.size_bytes / 1e9:.2f} GB"


def _print_next(recording: Recording, folder: Path) -> None:
    if recording.kind != "kitti":
        plain_console.print(f"To track it: jaxslam run {shlex.quote(str(folder))}")


def _fetch_and_unpack(recording: Recording, url: str, archive: Path, target: Path) -> None:
    with download_bar() as progress:
        if archive.is_file():
            _check(recording, archive)
        else:
            space: Callable[[int, int], None] = lambda done, total: _require_space(
                archive.parent, total - done + _UNPACKED_PER_ARCHIVE * total
            )
            fetch(recording, url, archive, progress, title="Downloading", require_space=space)
        _require_space(target.parent, _UNPACKED_PER_ARCHIVE * archive.stat().st_size)
        task = progress.add_task("Unpacking", total=None)
        try:
            unpack(
                archive,
                target,
                holds=("rgb.txt", "depth.txt"),
                progress=lambda done, total: progress.update(task, completed=done, total=total),
            )
        except DatasetError as failure:
            raise DatasetError(f"{failure}. To begin anew, delete {archive}") from failure


def _check(recording: Recording, archive: Path) -> None:
    """Raise if an archive that was there already is not the one expected."""
    problem = None
    try:
        size = archive.stat().st_size
        if recording.size_bytes not in (None, size):
            problem = f"expected {recording.size_bytes} bytes, got {size}"
        elif recording.sha256 is not None and (got := sha256_of(archive)) != recording.sha256:
            problem = f"expected SHA-256 {recording.sha256}, got {got}"
    except OSError as failure:
        raise DatasetError(f"{archive}: cannot be read: {failure}") from failure
    if problem is not None:
        raise DatasetError(f"{archive}: {problem}: another file, or a damaged one. To begin anew, delete it")


def _require_space(folder: Path, needed: float) -> None:
    existing = next(place for place in (folder.absolute(), *folder.absolute().parents) if place.exists())
    free = shutil.disk_usage(existing).free
    if free < needed:
        raise DatasetError(
            f"{folder}: expected {needed / 1e9:.2f} GB of free space for the archive and what it holds,"
            f" got {free / 1e9:.2f} GB; --out names another folder"
        )


def _delete(archive: Path) -> None:
    try:
        archive.unlink()
    except OSError as failure:
        raise DatasetError(f"{archive}: unpacked, but cannot be deleted: {failure}") from failure
