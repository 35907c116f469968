"""Files of the real networks that this machine has."""

import os
from pathlib import Path

import pytest

_FOLDER = os.environ.get("JAXSLAM_MODELS")  # before it is hidden from tests


def real_network(name: str) -> Path:
    """Return the file of a network, or skip the test."""
    if not _FOLDER:
        pytest.skip("JAXSLAM_MODELS is not set: no networks here")
    path = Path(_FOLDER).resolve() / f"{name}.onnx"
    if not path.is_file():
        pytest.skip(f"JAXSLAM_MODELS holds no {path.name}")
    return path
