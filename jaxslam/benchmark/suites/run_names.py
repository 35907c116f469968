"""Names of the folders of runs, and of values inside nested settings."""

import hashlib
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

_UNSAFE = re.compile(r"[^A-Za-z0-9._=,@+\[\]-]")
_LONGEST, _KEPT, _MARK = 100, 80, 8


def run_folder(sequence: str, label: str, seed: int) -> Path:
    """Return the folder of the files of a run, relative to the folder of the results.

    Args:
        sequence: Name of the sequence in its suite.
        label: Preset and variant, as in tables. A value in it may hold slashes, or be longer than a name of a file.
        seed: Seed of the run.
    """
    return Path(sequence) / _folder_name(label) / str(seed)


def flattened(content: object, path: str = "") -> dict[str, Any]:
    """The leaves of nested mappings by their dotted names; an empty mapping is a leaf, as lists are."""
    if not isinstance(content, Mapping) or not content:
        return {path: content}
    return {
        name: value
        for key, inner in content.items()
        for name, value in flattened(inner, f"{path}.{key}" if path else str(key)).items()
    }


def _folder_name(label: str) -> str:
    """The label itself if it can be a folder's; otherwise what is left of it, with a hash that tells it from others."""
    safe = _UNSAFE.sub("_", label)
    if safe == label and len(label) <= _LONGEST:
        return label
    return f"{safe[:_KEPT]}-{hashlib.sha256(label.encode()).hexdigest()[:_MARK]}"
