"""What is compiled is kept between processes, in jaxslam's folder or in one that the user chose."""

from collections.abc import Iterator
from pathlib import Path

import jax
import pytest

from jaxslam.xla import cache_dir, enable_compile_cache

FOLDER, LEAST_S = "jax_compilation_cache_dir", "jax_persistent_cache_min_compile_time_secs"


@pytest.fixture(autouse=True)
def _settings_stay() -> Iterator[None]:
    before = {name: jax.config.values[name] for name in (FOLDER, LEAST_S)}
    yield
    for name, value in before.items():
        jax.config.update(name, value)


@pytest.mark.parametrize("own", [True, False])
def test_small_programs_are_kept_too(tmp_path: Path, own: bool) -> None:
    """A tracker has some 25 programs that JAX alone would compile at every start."""
    jax.config.update(FOLDER, str(tmp_path) if own else None)
    jax.config.update(LEAST_S, 1.0)
    folder = enable_compile_cache()
    assert folder == (tmp_path if own else cache_dir())
    assert jax.config.values[FOLDER] == str(folder)
    assert jax.config.values[LEAST_S] < 0.1


def test_limit_of_the_user(tmp_path: Path) -> None:
    jax.config.update(FOLDER, str(tmp_path))
    jax.config.update(LEAST_S, 3.0)
    assert enable_compile_cache() == tmp_path
    assert jax.config.values[LEAST_S] == 3.0
