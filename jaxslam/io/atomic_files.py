"""Writing files so that a reader sees all of one or nothing, and checking before hours of work that one can."""

import contextlib
import os
import platform
import re
import stat
import tempfile
from collections.abc import Iterator
from pathlib import Path

from jaxslam.errors import JaxSlamError

_SPACE_BYTES = 1 << 20
"""Free space without which no work is begun: the trajectories and tables of a run of some minutes take as much."""


@contextlib.contextmanager
def replacing(path: str | os.PathLike[str], error: type[JaxSlamError] = JaxSlamError) -> Iterator[Path]:
    """A temporary name beside a file, to be written under; the file is moved to its place when the block ends well.

    A crash leaves the old file as it was; what a killed process left under a temporary name is removed by the next one
    that writes the same file. The content is on the disk before the file gets its name. A link stays, and the file it
    leads to is replaced. The folder must exist; the file gets the usual permissions.

    Raises:
        JaxSlamError: Of class `error`, if the file cannot be written.
    """
    target = _target(path, error)
    temporary = target.with_name(f".{target.name}.{os.getpid()}@{platform.node()}.tmp")
    try:
        _remove_leftovers(target)
        yield temporary
        _flush(temporary)
        os.replace(temporary, target)
        _flush(target.parent)
    except OSError as failure:
        raise error(f"{path}: cannot be written: {_reason(failure)}") from failure
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink()


def write_atomically(path: str | os.PathLike[str], data: bytes, error: type[JaxSlamError] = JaxSlamError) -> None:
    """Write a file as `replacing` does.

    Raises:
        JaxSlamError: Of class `error`, if the file cannot be written.
    """
    with replacing(path, error) as temporary:
        temporary.write_bytes(data)


def make_folder(path: Path, error: type[JaxSlamError] = JaxSlamError, option: str = "--out") -> None:
    """Make a folder for results, if it is not there, and see whether files can be written in it: now, not after hours.

    Args:
        path: The folder.
        error: Class of the error to raise.
        option: Option of the command that named the folder, for the error message.

    Raises:
        JaxSlamError: Of class `error`, if it is a file, is read-only, or its disk is full.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
        _write_probe(path)
    except FileExistsError:
        raise error(f"{option}: '{path}' cannot be written to: expected a folder, got a file") from None
    except OSError as problem:
        raise error(f"{option}: '{path}' cannot be written to: {_reason(problem)}") from None


def check_writable(path: Path, option: str, error: type[JaxSlamError] = JaxSlamError) -> None:
    """See whether a file could be written with `replacing`: now, not after hours. Nothing is written to the file.

    Args:
        path: The file; it need not exist, its folder must.
        option: Option of the command that named the file, for the error message.
        error: Class of the error to raise.

    Raises:
        JaxSlamError: Of class `error`, if the folder does not exist, is read-only or its disk is full, or if the path
            is that of a folder or device.
    """
    try:
        target = _target(path, error)
        _write_probe(target.parent)
    except OSError as problem:
        raise error(f"{option}: '{path}' cannot be written: {_reason(problem)}") from None
    except JaxSlamError as problem:
        raise error(f"{option}: {problem}") from None


def _target(path: str | os.PathLike[str], error: type[JaxSlamError]) -> Path:
    """The regular file that a path leads to, through links, or will lead to.

    Raises:
        JaxSlamError: Of class `error`, if the path is empty, or leads to a folder, a device, a pipe or in a circle.
    """
    given = os.fspath(path)
    if not given or "\0" in given:
        raise error(f"{given!a:.40}: cannot be written: expected the path of a file")
    target = Path(os.path.realpath(given))
    try:
        mode = target.stat().st_mode
    except FileNotFoundError:
        if given.endswith(os.sep):
            raise error(f"{path}: cannot be written: expected a file, got the path of a folder") from None
        return target
    except OSError as failure:
        raise error(f"{path}: cannot be written: {_reason(failure)}") from None
    if not stat.S_ISREG(mode):
        kind = "a folder" if stat.S_ISDIR(mode) else "a device, pipe or socket"
        raise error(f"{path}: cannot be written: expected a file, got {kind}")
    return target


def _remove_leftovers(target: Path) -> None:
    """Remove what processes of this machine that are no more left under temporary names of a file."""
    pattern = re.compile(rf"\.{re.escape(target.name)}\.(\d+)@{re.escape(platform.node())}\.tmp")
    with os.scandir(target.parent) as entries:
        found = [(entry.path, pattern.fullmatch(entry.name)) for entry in entries]
    for left, match in found:
        if match is not None and not _runs(int(match[1])):
            with contextlib.suppress(FileNotFoundError):  # another process removes it too
                os.unlink(left)


def _runs(process: int) -> bool:
    try:
        os.kill(process, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:
        return True  # another user's
    return True


def _flush(path: Path) -> None:
    """Wait until a file or folder is on the disk, so that a power cut leaves no empty file under a good name."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _write_probe(folder: Path) -> None:
    """Write as much as a small result takes to a file in a folder, and remove it.

    Raises:
        OSError: If there is no such folder, it cannot be written to, or its disk is full.
    """
    with tempfile.TemporaryFile(dir=folder) as file:
        file.write(bytes(_SPACE_BYTES))
        file.flush()
        os.fsync(file.fileno())


def _reason(failure: OSError) -> str:
    """What went wrong, without the temporary name of the file."""
    return failure.strerror or str(failure)
