"""What tests of the host share."""

from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import jax
import pytest

from jaxslam import known_models

COMPILED = "/jax/core/compile/backend_compile_duration"


@pytest.fixture
def compiled() -> Iterator[list[str]]:
    """The names of the programs XLA compiles, or loads from the cache on disk, during a test."""
    names: list[str] = []

    def listener(event: str, duration_secs: float, **details: str | int) -> None:
        if event == COMPILED:
            names.append(str(details.get("fun_name")))

    jax.monitoring.register_event_duration_secs_listener(listener)
    yield names
    jax.monitoring.unregister_event_duration_listener(listener)


@pytest.fixture(autouse=True)
def _no_networks(request: pytest.FixtureRequest) -> None:
    """The default network is not there, whatever there is on this machine; but for tests marked `networks`."""
    if request.node.get_closest_marker("networks") is None:
        request.getfixturevalue("models_cache")


@pytest.fixture
def models_cache(monkeypatch: pytest.MonkeyPatch, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An empty cache folder for networks, and no folder of the user's."""
    monkeypatch.delenv("JAXSLAM_MODELS", raising=False)
    cache = tmp_path_factory.mktemp("cache")
    # Only there: what is compiled stays in the user's own cache.
    monkeypatch.setattr(known_models, "platformdirs", SimpleNamespace(user_cache_dir=lambda *_, **__: str(cache)))
    folder = cache / "models"
    folder.mkdir()
    return folder
