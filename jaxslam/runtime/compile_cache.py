"""The cache of compiled code: where XLA, JAX's compiler, keeps it between processes."""

import functools
import logging
import tempfile
from pathlib import Path

import platformdirs

from jaxslam.io.folder_ownership import OWN_MODE, why_not_own

_log = logging.getLogger(__name__)


def cache_dir() -> Path:
    """Return the default folder of compiled code: `xla` in the user's cache folder for jaxslam."""
    return Path(platformdirs.user_cache_dir("jaxslam", appauthor=False)) / "xla"


_CACHE_ENABLED = "jax_enable_compilation_cache"
_MIN_COMPILE, _MIN_COMPILE_OF_JAX_S = "jax_persistent_cache_min_compile_time_secs", 1.0
_MIN_COMPILE_S = 0.05
"""Programs that take less are compiled anew, unless the user chose otherwise. With 0.5 some 25 of a run's 40 were,
every time; with JAX's own limit, a second, even more."""


def compile_cache_dir() -> Path:
    """Return the folder of compiled code: the one chosen in JAX's settings, else `cache_dir()`."""
    import jax  # noqa: PLC0415 - `usable_cores` and `cache_dir` need none

    chosen: str | None = jax.config.values["jax_compilation_cache_dir"]
    return Path(chosen) if chosen else cache_dir()


def enable_compile_cache() -> Path | None:
    """Keep compiled code between processes, so that only the first start on a machine waits for the compiler.

    `Slam` does it when it begins; what is compiled before, such as the renderer of rooms, is kept if this comes first.
    A folder that cannot be written to is read from only; where there is none and none can be made, or `cache_dir()` is
    not the user's own, nothing is kept. One warning says so.

    Returns:
        The folder: the user's own where one was chosen in JAX's settings, else `cache_dir()`; `None` if nothing is
        kept.
    """
    import jax  # noqa: PLC0415

    if not jax.config.values[_CACHE_ENABLED]:
        return None
    folder = compile_cache_dir()
    if not _is_usable(folder, chosen=bool(jax.config.values["jax_compilation_cache_dir"])):
        jax.config.update(_CACHE_ENABLED, False)
        return None
    jax.config.update("jax_compilation_cache_dir", str(folder))
    least_s: float = jax.config.values[_MIN_COMPILE]
    if not _is_writable(folder):
        jax.config.update(_MIN_COMPILE, float("inf"))  # JAX warns of every program otherwise
    elif least_s == _MIN_COMPILE_OF_JAX_S:
        jax.config.update(_MIN_COMPILE, _MIN_COMPILE_S)
    return folder


@functools.cache
def _is_usable(folder: Path, *, chosen: bool) -> bool:
    """Whether a folder can be used for compiled code; if not, that is logged. Looked at once a process."""
    try:
        folder.mkdir(mode=OWN_MODE, parents=True, exist_ok=True)
        why = None if chosen else why_not_own(folder)
    except OSError as problem:
        why = f"it cannot be made: {problem.strerror}"
    if why is not None:
        _log.warning("%s: not used to keep compiled code, so that every start takes longer: %s", folder, why)
    return why is None


@functools.cache
def _is_writable(folder: Path) -> bool:
    """Whether files can be written in a folder; if not, that is logged. Looked at once a process."""
    try:
        with tempfile.TemporaryFile(dir=folder):
            return True
    except OSError as problem:
        _log.warning("%s: compiled code cannot be kept, so that starts take longer: %s", folder, problem.strerror)
        return False
