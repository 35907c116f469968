"""Writing files so that a reader sees all of one or nothing."""

import contextlib
import os
import tempfile
from collections.abc import Iterator
from pathlib import Path

from jaxslam.errors import JaxSlamError


@contextlib.contextmanager
def replacing(path: str | os.PathLike[str], error: type[JaxSlamError] = JaxSlamError) -> Iterator[Path]:
    """A temporary name beside a file, to be written under; the file is moved to its place when the block ends well.

    A crash leaves the old file as it was. The folder must exist; the file gets the usual permissions.

    Raises:
        JaxSlamError: Of class `error`, if the file cannot be written.
    """
    target = Path(path)
    temporary = target.with_name(f".{target.name}.{os.getpid()}.tmp")
    try:
        yield temporary
        os.replace(temporary, target)
    except OSError as failure:
        raise error(f"{target}: cannot be written: {failure}") from failure
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


def make_folder(path: Path, error: type[JaxSlamError] = JaxSlamError) -> None:
    """Make a folder for results, if it is not there, and see whether files can be written in it: now, not after hours.

    Raises:
        JaxSlamError: Of class `error`, if not.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=path):
            pass
    except OSError as problem:
        raise error(f"--out: '{path}' cannot be written to: {problem.strerror}") from None
