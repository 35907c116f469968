"""Paths in descriptions of worlds: beside the description, or in the folders of recordings and networks."""

import os
from pathlib import Path

from jaxslam.errors import ConfigError

_VARIABLES = ("JAXSLAM_DATA", "JAXSLAM_MODELS")


def data_path(given: str, folder: Path) -> Path:
    """Return the file or folder that a description names.

    Args:
        given: A path relative to `folder`, an absolute one, or one that begins with `$JAXSLAM_DATA/` or
            `$JAXSLAM_MODELS/`.
        folder: Folder of the description.

    Raises:
        ConfigError: The path begins with another variable, or with one that is not set.
    """
    if not given.startswith("$"):
        return folder / given
    variable, _, rest = given[1:].partition("/")
    if variable not in _VARIABLES or not rest:
        expected = " or ".join(f"${name}/" for name in _VARIABLES)
        raise ConfigError(f"path: expected one that begins with {expected}, or no variable, got '{given}'")
    root = os.environ.get(variable)
    if not root:
        raise ConfigError(f"{variable}: expected the folder in which '{given}' lies, got nothing: it is not set")
    return Path(root) / rest


def beside(given: str, folder: Path) -> str:
    """Return a path that is right wherever it is read from; a variable in it stays until `data_path` reads it.

    Args:
        given: A path as in `data_path`.
        folder: Folder of the description.
    """
    return given if given.startswith("$") else str(folder / given)
