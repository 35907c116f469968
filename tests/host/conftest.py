"""What tests of the host share."""

from collections.abc import Iterator
from pathlib import Path

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


@pytest.fixture
def models_cache(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """An empty cache folder for networks, and no folder of the user's."""
    monkeypatch.delenv("JAXSLAM_MODELS", raising=False)
    monkeypatch.setattr(known_models.platformdirs, "user_cache_dir", lambda *_, **__: str(tmp_path / "cache"))
    folder = tmp_path / "cache" / "models"
    folder.mkdir(parents=True)
    return folder
