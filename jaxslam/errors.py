"""The errors jaxslam raises at its edge: every one is a `JaxSlamError` and prints as one line."""

import reprlib
from collections.abc import Iterable


class JaxSlamError(Exception):
    """Bad input or a bad setting; the message names the field, what was expected and what came."""


class FrameError(JaxSlamError):
    """A frame that cannot be used: wrong type, shape, or a time that goes backwards."""


class ConfigError(JaxSlamError):
    """An unknown key or preset, or a value of the wrong type or out of range."""


class CameraError(JaxSlamError):
    """A camera file that is missing, unreadable, incomplete or implausible."""


class DatasetError(JaxSlamError):
    """A recording that is missing, incomplete or unreadable."""


class TrajectoryError(JaxSlamError):
    """A trajectory file that is unreadable, or two trajectories that cannot be compared."""


class MapFileError(JaxSlamError):
    """A map file that is missing, damaged, of another format or version, or that cannot be written."""


class ModelError(JaxSlamError):
    """A network that is missing, damaged, or of a kind that is not supported."""


class MissingModelError(ModelError):
    """A known network that the settings need and that is not on this machine; the message says how to get it."""


class DownloadError(JaxSlamError):
    """A file that cannot be fetched, or is not the one expected; the message says where to place it by hand."""


class BenchmarkError(JaxSlamError):
    """A suite, a baseline or the results of a benchmark that are missing, damaged or do not fit together."""


def brief_repr(value: object) -> str:
    """A value in one short line for a message, whatever it is."""
    return " ".join(reprlib.repr(value).split())


def nearest(name: str, valid: Iterable[str]) -> str:
    """A hint for a misspelt name: ` (did you mean 'x'?)` or, when nothing is close, the valid names."""
    import difflib  # noqa: PLC0415 - used only where a name is wrong

    choices = sorted(valid)
    close = difflib.get_close_matches(name, choices, n=1)
    if close:
        return f" (did you mean '{close[0]}'?)"
    return f" (valid: {', '.join(choices)})" if choices else ""


def one_line(text: object, most: int = 160) -> str:
    """What a file or another library says, as a part of an error message: in one line and not longer than `most`."""
    line = " ".join(str(text).split())
    return line if len(line) <= most else f"{line[: most - 3]}..."
