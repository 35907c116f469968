"""What is compiled is kept between processes, in jaxslam's folder or in one that the user chose."""

import functools
import logging
import os
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from types import FunctionType

import jax
import jax.numpy as jnp
import pytest
from jax.experimental.compilation_cache import compilation_cache

from jaxslam.io.folder_ownership import why_not_own
from jaxslam.runtime import compile_cache as xla
from jaxslam.runtime import trace_cache
from jaxslam.runtime.compile_cache import cache_dir, enable_compile_cache
from jaxslam.runtime.trace_cache import cached_trace

FOLDER, MIN_S = "jax_compilation_cache_dir", "jax_persistent_cache_min_compile_time_secs"
ENABLED = "jax_enable_compilation_cache"


@pytest.fixture(autouse=True)
def _settings_stay(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setattr(trace_cache, "sources_hash", lambda: "these")
    before = {name: jax.config.values[name] for name in (FOLDER, MIN_S, ENABLED)}
    compilation_cache.reset_cache()
    yield
    for name, value in before.items():
        jax.config.update(name, value)
    compilation_cache.reset_cache()


def _times(x: jax.Array, factor: int) -> jax.Array:
    return x * factor


def _of_jaxslam(factor: int) -> Callable[[jax.Array], jax.Array]:
    """A program of its own, as if it were of the package."""
    name = {"__name__": "jaxslam.something"}
    ours = FunctionType(_times.__code__, globals() | name, "times", (jnp.float32(factor).item(),))
    return functools.update_wrapper(ours, _times)


def _read_only(*_: object, **__: object) -> None:
    raise OSError(30, "Read-only file system")


def enable_as_chosen(folder: Path) -> None:
    """As a user who has set `JAX_COMPILATION_CACHE_DIR`; every program is kept."""
    jax.config.update(FOLDER, str(folder))
    jax.config.update(MIN_S, 0.0)
    assert enable_compile_cache() == folder


@pytest.mark.parametrize("own", [True, False])
def test_small_programs_are_kept_too(tmp_path: Path, own: bool) -> None:
    """A tracker has some 25 programs that JAX alone would compile at every start."""
    jax.config.update(FOLDER, str(tmp_path) if own else None)
    jax.config.update(MIN_S, 1.0)
    folder = enable_compile_cache()
    assert folder == (tmp_path if own else cache_dir())
    assert jax.config.values[FOLDER] == str(folder)
    assert jax.config.values[MIN_S] < 0.1


def test_limit_of_the_user(tmp_path: Path) -> None:
    jax.config.update(FOLDER, str(tmp_path))
    jax.config.update(MIN_S, 3.0)
    assert enable_compile_cache() == tmp_path
    assert jax.config.values[MIN_S] == 3.0


def warnings_of(log: pytest.LogCaptureFixture) -> list[str]:
    return [record.getMessage() for record in log.records if record.levelno == logging.WARNING]


def test_folder_that_cannot_be_made_is_one_line(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """Nor does JAX say it again for each program."""
    (tmp_path / "file").write_text("")
    jax.config.update(FOLDER, str(tmp_path / "file" / "xla"))
    for factor in (3, 4):
        assert enable_compile_cache() is None
        jax.jit(cached_trace(_of_jaxslam(factor)))(jnp.ones(2)).block_until_ready()
    (line,) = warnings_of(caplog)
    assert line.startswith(f"{tmp_path}/file/xla: not used to keep compiled code, so that every start takes longer: ")


def test_folder_that_cannot_be_written_is_one_line(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What is in it is still read. Root may write everywhere, so that the disk is taken to be read-only."""
    enable_as_chosen(tmp_path)
    written = _of_jaxslam(5)
    jax.jit(cached_trace(written))(jnp.ones(2)).block_until_ready()
    before = sorted(tmp_path.rglob("*"))
    assert len(before) > 1
    xla._is_writable.cache_clear()
    monkeypatch.setattr(tempfile, "TemporaryFile", _read_only)
    monkeypatch.setattr(os, "replace", _read_only)
    monkeypatch.setattr(Path, "touch", _read_only)
    made, make = [], trace_cache._traced
    monkeypatch.setattr(trace_cache, "_traced", lambda *arguments: (made.append(1), make(*arguments))[1])
    for _ in range(2):
        assert enable_compile_cache() == tmp_path
    jax.clear_caches()
    for function in (written, _of_jaxslam(6), _of_jaxslam(7)):
        jax.jit(cached_trace(function))(jnp.ones(2)).block_until_ready()
    lines = warnings_of(caplog)
    assert lines[0].startswith(f"{tmp_path}: compiled code cannot be kept")
    assert len(lines) == 1
    assert len(made) == 2  # the first one was read
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.parametrize(("mode", "words"), [(0o777, "other users may write to it; chmod"), (0o775, "chmod go-w")])
def test_own_folder_that_others_may_write_to(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch, mode: int, words: str
) -> None:
    folder = tmp_path / "xla"
    folder.mkdir()
    folder.chmod(mode)
    monkeypatch.setattr(xla, "cache_dir", lambda: folder)
    jax.config.update(FOLDER, None)
    assert enable_compile_cache() is None
    assert words in caplog.text


def test_folder_of_another_user(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert why_not_own(tmp_path) is None
    monkeypatch.setattr(os, "geteuid", lambda: tmp_path.stat().st_uid + 1)
    assert "not to you" in (why_not_own(tmp_path) or "")


def test_folders_that_are_made_are_the_users_own(tmp_path: Path) -> None:
    """Where files are made for a group by default, too."""
    umask = os.umask(0o002)
    try:
        enable_as_chosen(tmp_path / "new")
        jax.jit(cached_trace(_of_jaxslam(8)))(jnp.ones(2)).block_until_ready()
    finally:
        os.umask(umask)
    assert why_not_own(tmp_path / "new") is None
    assert why_not_own(tmp_path / "new" / "traces") is None
