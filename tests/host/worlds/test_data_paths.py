"""Paths in descriptions of worlds."""

from pathlib import Path

import pytest

from jaxslam.errors import ConfigError
from jaxslam.worlds.data_paths import beside, data_path


def test_is_beside_the_description():
    assert data_path("crowd/rgb", Path("/worlds")) == Path("/worlds/crowd/rgb")
    assert data_path("/crowd", Path("/worlds")) == Path("/crowd")
    assert beside("crowd", Path("/worlds")) == "/worlds/crowd"


def test_a_variable_is_its_value_when_the_path_is_read(monkeypatch):
    kept = beside("$JAXSLAM_DATA/crowd/rgb", Path("/worlds"))
    monkeypatch.setenv("JAXSLAM_DATA", "/recordings")
    assert data_path(kept, Path("/elsewhere")) == Path("/recordings/crowd/rgb")


@pytest.mark.parametrize("value", [None, ""])
def test_a_variable_that_is_not_set_is_named(monkeypatch, value):
    monkeypatch.delenv("JAXSLAM_MODELS", raising=False)
    if value is not None:
        monkeypatch.setenv("JAXSLAM_MODELS", value)
    with pytest.raises(ConfigError, match=r"JAXSLAM_MODELS: expected the folder in which '\$JAXSLAM_MODELS/a.onnx'"):
        data_path("$JAXSLAM_MODELS/a.onnx", Path())


@pytest.mark.parametrize("given", ["$HOME/crowd", "$JAXSLAM_DATA", "$JAXSLAM_DATA/", "$", "${JAXSLAM_DATA}/crowd"])
def test_other_variables_are_refused(monkeypatch, given):
    monkeypatch.setenv("JAXSLAM_DATA", "/recordings")
    with pytest.raises(ConfigError, match=r"expected one that begins with \$JAXSLAM_DATA/ or \$JAXSLAM_MODELS/"):
        data_path(given, Path())
