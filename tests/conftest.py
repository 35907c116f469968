"""Strict settings for every test: no silent promotion of types or ranks; warnings are errors (pyproject)."""

import gc
import os
from pathlib import Path

import jax
import pytest
from fast_compile_flags import FAST_COMPILE_FLAGS

jax.config.update("jax_numpy_dtype_promotion", "strict")
jax.config.update("jax_numpy_rank_promotion", "raise")

_FOR_ALL = (
    "jax_compilation_cache_dir",
    "jax_persistent_cache_min_compile_time_secs",
    "jax_numpy_dtype_promotion",
    "jax_numpy_rank_promotion",
    "jax_traceback_in_locations_limit",
)


def pytest_configure(config: pytest.Config) -> None:
    """Tests compile more than they compute, so they compile fast; benchmarks have kernels as users have them.

    Half of the time is for compiling even so.
    """
    if "benchmark" not in config.option.markexpr.replace("not benchmark", ""):
        flags = os.environ.get("XLA_FLAGS", "").split()
        os.environ["XLA_FLAGS"] = " ".join([*flags, *(flag for flag in FAST_COMPILE_FLAGS if flag not in flags)])


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Do not import benchmarks that will not run: six seconds of each process."""
    return True if collection_path.name == "benchmarks" and "not benchmark" in config.option.markexpr else None


def pytest_sessionstart() -> None:
    """One thread for each worker, and every program compiled once for all processes: pytest's, and those tests start.

    These are strict too: a program that was traced with other rules has parts of other names, and is another one.
    """
    from jaxslam.runtime.compile_cache import enable_compile_cache  # noqa: PLC0415 - before it there are no type checks
    from jaxslam.runtime.threads import prefer_one_thread  # noqa: PLC0415 - before it there are no type checks

    prefer_one_thread()
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)  # a small one is loaded in a tenth of its time
    jax.config.update("jax_traceback_in_locations_limit", 0)  # 10 % of the time of the kernels' tests
    enable_compile_cache()
    for name in _FOR_ALL:
        os.environ[name.upper()] = str(jax.config.values[name])


def pytest_collection_finish() -> None:
    """What has been imported stays, and tracing makes much that does not go round in circles: Python looks less often.

    Tests of kernels take 8 % less time so.
    """
    gc.collect()
    gc.freeze()
    gc.set_threshold(100_000, 10, 10)


_LONGEST = (
    "test_readme",
    "test_step",
    "test_keyframe_semantics",
    "test_pose_graph",
    "test_step_gradient",
    "test_relocalization",
    "test_epipolar",
    "test_back_end",
    "test_bundle_adjust",
    "test_occlusion_states",
    "test_lens",
    "test_pnp",
)
"""Files that take 20 seconds or more. The first two compile the trackers of 640x480 and of small scenes, one each,
which most of the others then load."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """The longest files come first, so that at the end no process waits for another one."""
    items.sort(key=lambda item: _LONGEST.index(item.path.stem) if item.path.stem in _LONGEST else len(_LONGEST))


def _folder(variable: str) -> Path:
    value = os.environ.get(variable)
    if not value:
        pytest.skip(f"{variable} is not set: no recordings here")
    return Path(value).resolve()


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """The folder of real recordings, or a skip."""
    return _folder("JAXSLAM_DATA")


@pytest.fixture
def float64():
    """JAX's float64 during a test; a module asks for it with `pytestmark = pytest.mark.usefixtures("float64")`."""
    with jax.enable_x64(True):
        yield


@pytest.fixture(autouse=True)
def _number_of_threads_stays():
    """What a command sets for its own process is not told to the tests after it."""
    chosen = os.environ.get("NPROC")
    yield
    if chosen is None:
        os.environ.pop("NPROC", None)
    else:
        os.environ["NPROC"] = chosen


_MAX_MAPS = 20_000
"""Of memory, after which compiled programs are dropped: a process may have 65,530 on Linux. A small program takes 7, a
tracker with its map 5,200, and what is compiled beyond the limit crashes or hangs the process."""


@pytest.fixture(autouse=True, scope="module")
def _programs_are_few_and_frozen():
    """Those of earlier files are compiled again, or loaded from the disk, where they are needed.

    What stays is not looked at again: trackers collect garbage before they begin, which took 2 s each otherwise.
    """
    yield
    maps = Path("/proc/self/maps")
    if maps.is_file() and maps.read_bytes().count(b"\n") > _MAX_MAPS:
        gc.unfreeze()
        jax.clear_caches()
    gc.collect()
    gc.freeze()
