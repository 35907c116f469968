"""Write files atomically, and check before hours of work that they can be written."""

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
"""Free space that must be available before work begins. The trajectories and tables of a run of a few minutes take
this much."""


@contextlib.contextmanager
def replacing(path: str | os.PathLike[str], error: type[JaxSlamError] = JaxSlamError) -> Iterator[Path]:
    """Yield a temporary path beside a file; what is written there replaces the file if the block raises no error.

    A crash leaves the old file unchanged. The temporary file of a killed process is removed by the next process that
    writes the same file. The content is flushed to the disk before the file is renamed. A symbolic link is kept, and
    the file that it points to is replaced. The folder must exist. The file gets the default permissions.

    Args:
        path: File to replace or create.
        error: Class of the error to raise.

    Raises:
        JaxSlamError: An error of class `error`, if the file cannot be written.
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
    """Write a file atomically, as `replacing` does.

    Args:
        path: File to replace or create.
        data: Content of the file.
        error: Class of the error to raise.

    Raises:
        JaxSlamError: An error of class `error`, if the file cannot be written.
    """
    with replacing(path, error) as temporary:
        temporary.write_bytes(data)


def make_folder(path: Path, error: type[JaxSlamError] = JaxSlamError, option: str = "--out") -> None:
    """Create a folder for results if it is missing, and check before hours of work that files can be written in it.

    Args:
        path: Folder to create.
        error: Class of the error to raise.
        option: Option of the command that named the folder, for the error message.

    Raises:
        JaxSlamError: An error of class `error`, if it is a file, is read-only, or its disk is full.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
        _write_probe(path)
    except FileExistsError:
        raise error(f"{option}: '{path}' cannot be written to: expected a folder, got a file") from None
    except OSError as problem:
        raise error(f"{option}: '{path}' cannot be written to: {_reason(problem)}") from None


def check_writable(path: Path, option: str, error: type[JaxSlamError] = JaxSlamError) -> None:
    """Check before hours of work that a file could be written with `replacing`. The file is not changed.

    Args:
        path: File to check. It need not exist, but its folder must.
        option: Option of the command that named the file, for the error message.
        error: Class of the error to raise.

    Raises:
        JaxSlamError: An error of class `error`, if the folder does not exist, is read-only or its disk is full, or if
            the path is that of a folder or device.
    """
    try:
        target = _target(path, error)
        _write_probe(target.parent)
    except OSError as problem:
        raise error(f"{option}: '{path}' cannot be written: {_reason(problem)}") from None
    except JaxSlamError as problem:
        raise error(f"{option}: {problem}") from None


def _target(path: str | os.PathLike[str], error: type[JaxSlamError]) -> Path:
    """Follow a path through symbolic links to a regular file, which need not exist.

    Raises:
        JaxSlamError: An error of class `error`, if the path is empty, or leads to a folder, a device, a pipe or in a
            circle.
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
    """Remove the temporary files that killed processes of this machine left beside a file."""
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
    """Flush a file or folder to the disk, so that a power failure cannot leave an empty file under the final name."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _write_probe(folder: Path) -> None:
    """Write a file of the size of a small result in a folder, and remove it.

    Raises:
        OSError: If there is no such folder, it cannot be written to, or its disk is full.
    """
    with tempfile.TemporaryFile(dir=folder) as file:
        file.write(bytes(_SPACE_BYTES))
        file.flush()
        os.fsync(file.fileno())


def _reason(failure: OSError) -> str:
    """Return the reason of a failure, without the temporary name of the file."""
    return failure.strerror or str(failure)
