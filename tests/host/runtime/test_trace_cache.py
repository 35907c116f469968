"""Traces that are kept between processes: found again, never for another program, and no harm done by the disk."""

import functools
import logging
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from types import FunctionType
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxlie import SO3

from jaxslam.runtime import trace_cache
from jaxslam.runtime.trace_cache import cached_trace

FOLDER = "jax_compilation_cache_dir"


class Color(Enum):
    """Static."""

    RED = 1
    BLUE = 2


class Plan(NamedTuple):
    """Static too."""

    factor: float = 1
    name: str = "a"
    color: Color | None = None
    functions: tuple[Callable[..., Any], ...] = ()


class Given(NamedTuple):
    """What the program gives."""

    total: jax.Array
    turn: SO3
    key: jax.Array
    nothing: None = None


traces: list[tuple[int, ...]] = []
"""Shape of every trace."""


def program(a: jax.Array, turn: SO3, key: jax.Array, *, plan: Plan) -> Given:
    """A program with all that the tracker's have."""
    traces.append(a.shape)
    noise = jax.random.normal(key, a.shape, a.dtype)
    return Given(a * jnp.asarray(plan.factor, a.dtype) + noise, SO3(-turn.wxyz), jax.random.split(key)[0])


def make_function(number: int) -> Callable[..., int]:
    """One that differs from others by what it closes over."""
    return of_jaxslam(lambda: number)


def of_jaxslam(function: Any) -> Callable[..., Any]:
    """The function, as if it were of the package."""
    names = globals() | {"__name__": "jaxslam.something"}
    ours = FunctionType(function.__code__, names, function.__name__, function.__defaults__, function.__closure__)
    return functools.update_wrapper(ours, function)


def outside() -> None:
    """A function of a user."""


@dataclass
class Strict:
    """Cannot be made by calling it."""

    x: int

    def __post_init__(self) -> None:
        raise AssertionError


@functools.wraps(trace_cache.cached_trace)
def around_ours() -> None:
    """A function of a user, which says it was one of jaxslam."""


_program = of_jaxslam(program)
_TWICE = Plan(2.0)


def called(a: Any = (1.0, 2.0), plan: Plan = _TWICE) -> Given:
    """The program as the next process would call it: with nothing in memory."""
    jitted = jax.jit(cached_trace(_program), static_argnames="plan", donate_argnums=0)
    turn = SO3.from_z_radians(jnp.float32(0.3))
    return jitted(jnp.array(a, jnp.float32), turn, jax.random.key(7), plan=plan)


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Where traces are kept; as if nothing had been edited just now."""
    monkeypatch.setattr(trace_cache, "sources_hash", lambda: "these")
    before = jax.config.values[FOLDER]
    jax.config.update(FOLDER, str(tmp_path))
    traces.clear()
    yield tmp_path / "traces"
    jax.config.update(FOLDER, before)


def kept(folder: Path) -> list[Path]:
    """The files."""
    return sorted(folder.iterdir()) if folder.exists() else []


class TestFound:
    def test_second_call_is_not_traced(self, folder: Path) -> None:
        first, second = called(), called()
        assert traces == [(2,)]
        assert len(kept(folder)) == 1
        assert jax.tree.structure(first) == jax.tree.structure(second)
        for a, b in zip(jax.tree.leaves(first), jax.tree.leaves(second), strict=True):
            assert a.dtype == b.dtype
            if not jnp.issubdtype(a.dtype, jax.dtypes.prng_key):
                np.testing.assert_array_equal(a, b)
        assert (jax.random.key_data(first.key) == jax.random.key_data(second.key)).all()

    def test_same_as_without(self) -> None:
        turn, key = SO3.from_z_radians(jnp.float32(0.3)), jax.random.key(7)
        expected = jax.jit(program, static_argnames="plan")(jnp.array([1.0, 2], jnp.float32), turn, key, plan=Plan(2.0))
        np.testing.assert_array_equal(called().total, expected.total)
        np.testing.assert_array_equal(called().turn.wxyz, expected.turn.wxyz)

    def test_arguments_are_given_away(self) -> None:
        for _ in range(2):
            a = jnp.array([1.0, 2.0], jnp.float32)
            jitted = jax.jit(cached_trace(_program), static_argnames="plan", donate_argnums=0)
            jitted(a, SO3.identity(), jax.random.key(0), plan=Plan())
            assert a.is_deleted()

    def test_of_a_batch(self, folder: Path) -> None:
        def several(a: jax.Array) -> jax.Array:
            turn, key = SO3.from_z_radians(a[0, 0]), jax.random.key(7)
            return jax.vmap(lambda one: program(one, turn, key, plan=Plan()).total)(a)

        a = jnp.arange(6, dtype=jnp.float32).reshape(3, 2)
        for _ in range(2):
            np.testing.assert_array_equal(jax.jit(cached_trace(of_jaxslam(several)))(a), jax.jit(several)(a))
        assert len(kept(folder)) == 1

    def test_without_jit_it_is_the_function(self, folder: Path) -> None:
        result = cached_trace(_program)(jnp.ones(2), SO3.identity(), jax.random.key(0), plan=Plan())
        assert isinstance(result, Given)
        assert not kept(folder)

    def test_error_is_that_of_the_function(self, folder: Path) -> None:
        def wrong(a: jax.Array) -> jax.Array:
            raise ValueError("no")

        with pytest.raises(ValueError, match="no"):
            jax.jit(cached_trace(of_jaxslam(wrong)))(1.0)
        assert not kept(folder)


class TestOther:
    """What is another program is never taken for the one that is there."""

    @pytest.mark.parametrize(
        "other",
        [
            {"a": (1.0, 2.0, 3.0)},
            {"plan": Plan(2.5)},
            {"plan": Plan(2.0, "b")},
            {"plan": Plan(2.0, color=Color.BLUE)},
            {"plan": Plan(2.0, functions=(make_function(1),))},
        ],
        ids=lambda other: "_".join(map(str, other.values()))[:40],
    )
    def test_argument(self, folder: Path, other: dict[str, Any]) -> None:
        called()
        called(plan=Plan(2.0, color=Color.RED))
        called(plan=Plan(2.0, functions=(make_function(2),)))
        expected, got = called(**other), called(**other)
        assert len(traces) == len(kept(folder)) == 4
        np.testing.assert_array_equal(got.total, expected.total)

    def test_setting_of_jax(self, folder: Path) -> None:
        called()
        with jax.default_matmul_precision("highest"):
            called()
        assert len(kept(folder)) == 2

    def test_sources(self, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        called()
        monkeypatch.setattr(trace_cache, "sources_hash", lambda: "others")
        called()
        assert len(kept(folder)) == 2

    @pytest.mark.parametrize(
        "unknown",
        [outside, around_ours, functools.partial(outside), np.ones, Plan],
        ids=["function", "around_ours", "partial", "numpy", "class"],
    )
    def test_function_of_a_user_is_not_kept(self, folder: Path, unknown: Any) -> None:
        for _ in range(2):
            called(plan=Plan(functions=(unknown,)))
        assert len(traces) == 2
        assert not kept(folder)

    def test_partial_of_ours_is_kept(self, folder: Path) -> None:
        for number in (1, 2, 1):
            called(
                plan=Plan(
                    functions=(functools.partial(make_function(0), number, name=np.dtype(np.float32), kind=np.float32),)
                )
            )
        assert len(traces) == len(kept(folder)) == 2

    @pytest.mark.parametrize("setting", [FOLDER, "jax_enable_compilation_cache"])
    def test_nothing_is_kept_if_not_wanted(self, folder: Path, setting: str) -> None:
        before = jax.config.values[setting]
        jax.config.update(setting, None if setting == FOLDER else False)
        try:
            called()
        finally:
            jax.config.update(setting, before)
        assert not kept(folder)


class TestSources:
    """`sources_hash` itself, of which the other tests know nothing."""

    @pytest.fixture(autouse=True)
    def sources(self, folder: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[], str | None]:
        """The function as it is in the package, and a package of one file."""
        monkeypatch.undo()
        root = folder.parent / "ours"
        root.mkdir()
        self.file = root / "__init__.py"
        self.file.write_text("a = 1")
        monkeypatch.syspath_prepend(folder.parent)
        monkeypatch.setattr(trace_cache, "_PACKAGES", ("ours",))
        monkeypatch.setattr(trace_cache, "_loaded", time.time() + 60)
        self.patch = monkeypatch
        return trace_cache.sources_hash.__wrapped__

    def test_hash_is_of_the_content(self, sources: Callable[[], str | None]) -> None:
        first = sources()
        assert first == sources()
        self.file.write_text("a = 2")
        assert sources() not in {first, None}
        self.file.write_text("a = 1")
        assert sources() == first
        (self.file.parent / "more.py").write_text("")
        assert sources() not in {first, None}

    def test_unknown_if_edited_after_it_was_loaded(self, sources: Callable[[], str | None]) -> None:
        self.patch.setattr(trace_cache, "_loaded", time.time() - 60)
        assert sources() is None

    def test_unknown_if_not_there(self, sources: Callable[[], str | None]) -> None:
        self.patch.setattr(trace_cache, "_PACKAGES", ("not_there",))
        assert sources() is None


class TestDisk:
    @pytest.mark.parametrize(
        "damage", [lambda data: data[:-1], lambda data: data[:40] + b"x" + data[41:], lambda _: b""]
    )
    def test_damaged_file(
        self, folder: Path, damage: Callable[[bytes], bytes], caplog: pytest.LogCaptureFixture
    ) -> None:
        expected = called()
        (file,) = kept(folder)
        whole = file.read_bytes()
        file.write_bytes(damage(whole))
        with caplog.at_level(logging.WARNING):
            np.testing.assert_array_equal(called().total, expected.total)
        assert f"{file}: damaged" in caplog.text
        assert file.read_bytes() == whole
        assert len(traces) == 2

    def test_no_folder_can_be_made(self, folder: Path, caplog: pytest.LogCaptureFixture) -> None:
        folder.write_text("a file")
        expected = called()
        np.testing.assert_array_equal(called().total, expected.total)
        assert caplog.text.count("cannot be kept") == 1  # of two programs

    def test_unreadable(self, folder: Path, caplog: pytest.LogCaptureFixture) -> None:
        expected = called()
        (file,) = kept(folder)
        file.unlink()
        file.mkdir()
        np.testing.assert_array_equal(called().total, expected.total)
        assert f"{file}: cannot be read" in caplog.text

    def test_what_nobody_needs_is_removed(self, folder: Path) -> None:
        called()
        called(plan=Plan(3.0))
        used, unused = kept(folder)
        long_ago = time.time() - 40 * 86400
        for file in (used, unused):
            os.utime(file, (long_ago, long_ago))
        called(plan=Plan(2.0))
        called(plan=Plan(3.0))  # both are younger now that they were read
        os.utime(unused, (long_ago, long_ago))
        trace_cache._remove_old.cache_clear()
        called(plan=Plan(4.0))
        assert used in kept(folder)
        assert unused not in kept(folder)


class TestOthers:
    """Who can write to a folder could have the user run anything."""

    def test_folder_that_others_may_write_to_is_not_read(self, folder: Path, caplog: pytest.LogCaptureFixture) -> None:
        called()
        (file,) = kept(folder)
        folder.chmod(0o777)
        trace_cache._trusted.cache_clear()
        before = file.stat().st_mtime_ns
        called()
        assert len(traces) == 2  # traced anew, and had it been read it would be younger
        assert file.stat().st_mtime_ns == before
        assert len([record for record in caplog.records if "other users may write" in record.getMessage()]) == 1

    def test_no_code_of_a_class_is_called(self) -> None:
        """Nor is a class loaded that is not there."""
        name = f"{__name__}:Strict"
        assert trace_cache._structure_from_json([name, {"x": [1]}]).x == 1
        for name in ("not_loaded:Thing", "pathlib:no", "pathlib:Path.no", "pathlib:Path", "subprocess:Popen"):
            with pytest.raises(LookupError):
                trace_cache._structure_from_json([name, {}])

    def test_result_of_another_kind_is_not_kept(self) -> None:
        assert trace_cache._structure_to_json((1, {2: 3})) is None
        assert trace_cache._structure_to_json([object()]) is None


_RUN = """
from jaxslam import Slam, load_config
from jaxslam.runtime import trace_cache
from jaxslam.datasets.synthetic import SyntheticConfig, SyntheticDataset

made, make = [], trace_cache._traced
trace_cache._traced = lambda function, *args: (made.append(function), make(function, *args))[1]
room = SyntheticDataset(SyntheticConfig(frames=3))
with Slam(room.camera, load_config(overrides=["semantics.model=null", "run.deterministic=true"])) as slam:
    slam.run(room)
    print(len(made), slam.trajectory.T_world_cam.tolist())
"""


@pytest.mark.slow
def test_next_process_of_the_tracker_finds_all() -> None:
    """It traces nothing again, and gives the same digits."""
    shared = Path(os.environ["JAX_COMPILATION_CACHE_DIR"]) / "traces"
    run = lambda: subprocess.run([sys.executable, "-c", _RUN], check=True, capture_output=True, text=True).stdout
    first = run()
    assert len(kept(shared)) > 10
    num_made, poses = run().split(maxsplit=1)
    assert int(num_made) == 0
    assert poses == first.split(maxsplit=1)[1]
