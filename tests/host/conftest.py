"""What tests of the host share."""

import threading
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import jax
import pytest

from jaxslam.loop_closing.essential_graph import COMPILE_THREAD
from jaxslam.semantics import model_zoo

COMPILED = "/jax/core/compile/backend_compile_duration"


@pytest.fixture
def compiled() -> Iterator[list[str]]:
    """The names of the programs XLA compiles, or loads from the cache on disk, during a test.

    Graphs that are compiled ahead in threads of their own are left out: nothing waits for them.
    """
    names: list[str] = []

    def listener(event: str, duration_secs: float, **details: str | int) -> None:
        if event == COMPILED and threading.current_thread().name != COMPILE_THREAD:
            names.append(str(details.get("fun_name")))

    jax.monitoring.register_event_duration_secs_listener(listener)
    yield names
    jax.monitoring.unregister_event_duration_listener(listener)


@pytest.fixture(scope="session", autouse=True)
def _networks_hidden(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """The default network is not there, whatever there is on this machine; tests name the files they want."""
    with pytest.MonkeyPatch.context() as patch:
        _hide_networks(patch, tmp_path_factory.mktemp("cache"))
        yield


def _hide_networks(patch: pytest.MonkeyPatch, cache: Path) -> None:
    patch.delenv("JAXSLAM_MODELS", raising=False)
    # Only there: what is compiled stays in the user's own cache.
    patch.setattr(model_zoo, "platformdirs", SimpleNamespace(user_cache_dir=lambda *_, **__: str(cache)))


@pytest.fixture
def models_cache(monkeypatch: pytest.MonkeyPatch, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An empty cache folder for networks, and no folder of the user's."""
    cache = tmp_path_factory.mktemp("cache")
    _hide_networks(monkeypatch, cache)
    folder = cache / "models"
    folder.mkdir()
    return folder
