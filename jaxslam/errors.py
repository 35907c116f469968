"""Errors that jaxslam raises for bad input: each is a `JaxSlamError` and prints as one line."""

import reprlib
from collections.abc import Iterable


class JaxSlamError(Exception):
    """Bad input or a bad setting; the message names the field, the expected value and the given one."""


class FrameError(JaxSlamError):
    """A frame that cannot be used: it has a wrong type or shape, or its time goes backwards."""


class ConfigError(JaxSlamError):
    """An unknown key or preset, or a value of the wrong type or out of range."""


class CameraError(JaxSlamError):
    """A camera file that is missing, unreadable, incomplete or implausible."""


class DatasetError(JaxSlamError):
    """A recording that is missing, incomplete or unreadable."""


class TrajectoryError(JaxSlamError):
    """A trajectory file that cannot be read or written, or two trajectories that cannot be compared."""


class MapFileError(JaxSlamError):
    """A map file that is missing, damaged, of another format or version, or cannot be written."""


class ModelError(JaxSlamError):
    """A network file that is missing, damaged or of an unsupported kind."""


class MissingModelError(ModelError):
    """A known network that the settings require but that is not installed; the message says how to get it."""


class DownloadError(JaxSlamError):
    """A file that cannot be downloaded or has an unexpected checksum; the message says where to place it by hand."""


class BenchmarkError(JaxSlamError):
    """A benchmark suite, baseline or result that is missing, damaged or inconsistent with the others."""


def brief_repr(value: object) -> str:
    """Format any value as one short line for an error message."""
    return " ".join(reprlib.repr(value).split())


def nearest(name: str, valid: Iterable[str]) -> str:
    """Return a hint for a misspelled name: ` (did you mean 'x'?)` or, if no valid name is close, all valid names."""
    import difflib  # noqa: PLC0415 - used only where a name is wrong

    choices = sorted(valid)
    close = difflib.get_close_matches(name, choices, n=1)
    if close:
        return f" (did you mean '{close[0]}'?)"
    return f" (valid: {', '.join(choices)})" if choices else ""


def one_line(text: object, most: int = 160) -> str:
    """Format a text, such as another library's message, as one line of at most `most` characters."""
    line = " ".join(str(text).split())
    return line if len(line) <= most else f"{line[: most - 3]}..."
