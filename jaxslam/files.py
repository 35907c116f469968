"""Writing files so that a reader sees all of one or nothing."""

import contextlib
import os
from pathlib import Path

from jaxslam.errors import JaxSlamError


def write_atomically(path: str | os.PathLike[str], data: bytes, error: type[JaxSlamError] = JaxSlamError) -> None:
    """Write a file under a temporary name beside its place, then move it there.

    A crash leaves the old file as it was. The folder must exist; the file gets the usual permissions.

    Raises:
        JaxSlamError: Of class `error`, if the file cannot be written.
    """
    target = Path(path)
    temporary = target.with_name(f".{target.name}.{os.getpid()}.tmp")
    try:
        temporary.write_bytes(data)
        os.replace(temporary, target)
    except OSError as failure:
        raise error(f"{target}: cannot be written: {failure}") from failure
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink()
