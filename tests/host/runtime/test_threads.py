"""Threads of XLA, OpenCV, BLAS and networks: one number for all, whatever a program did before its first `Slam`."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
import tiny_models

from jaxslam import Camera, Slam, load_config
from jaxslam.config.schema import SemanticsConfig
from jaxslam.errors import ConfigError
from jaxslam.semantics import OnnxDetector
from jaxslam.semantics.from_config import detector_of

TRACKS = """
import logging, sys
logging.basicConfig(stream=sys.stdout, format="%(message)s")
import cv2, jax, jax.numpy as jnp
from jaxslam import Camera, Slam, load_config
camera = Camera("small", width=64, height=64, fx=60.0, fy=60.0, cx=31.5, cy=31.5, baseline_m=0.1)
def begin(threads):
    Slam(camera, load_config(overrides=["semantics.model=null", f"run.threads={threads}"])).close()
{body}
from jaxslam.runtime.threads import threads
print("threads", threads(), cv2.getNumThreads(), jax.config.values["jax_cpu_enable_async_dispatch"])
"""


def said(body: str, **environment: str) -> list[str]:
    """Run a program in a process of its own; return the lines it wrote."""
    others = {name: value for name, value in os.environ.items() if name != "NPROC"}
    done = subprocess.run(
        [sys.executable, "-c", TRACKS.replace("{body}", body)],
        capture_output=True,
        text=True,
        env=others | environment,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()


@pytest.mark.parametrize("number", [pytest.param(1, marks=pytest.mark.slow), 2])
def test_set_by_the_first_tracker(number: int) -> None:
    assert said(f"begin({number})") == [f"threads {number} {number} False"]


@pytest.mark.parametrize("number", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_of_blas(number: int) -> None:
    """Of NumPy, and of SciPy, which is loaded for the map."""
    found = said(
        f"slam = begin({number}); from jaxslam.runtime.preload import import_scipy; import_scipy({number})\n"
        "from threadpoolctl import threadpool_info\n"
        "print(sorted({library['num_threads'] for library in threadpool_info() if library['user_api'] == 'blas'}))"
    )
    assert found[0] == f"[{number}]"


def test_environment_outranks_it() -> None:
    """For XLA, and without a word: the user said so."""
    assert said("begin(1)", NPROC="3") == ["threads 3 1 False"]


def test_too_late_is_said_once() -> None:
    warned, *rest = said("jnp.zeros(3).block_until_ready(); begin(1); begin(1)")
    assert warned.startswith("XLA computes with ")
    assert "one queue since the first array of this process, not with run.threads=1" in warned
    assert len(rest) == 1


@pytest.mark.slow
def test_another_number_later_is_said() -> None:
    """A second tracker of the same process cannot have other threads."""
    warned, last = said("begin(1); begin(2)")
    assert warned.startswith("XLA computes with 1 threads since")
    assert last == "threads 1 2 False"


@pytest.mark.slow
def test_rendered_frames_before_the_first_tracker() -> None:
    """They are the first arrays of the process, and do not take the choice from the tracker."""
    rendered = "from jaxslam.datasets.synthetic import *; SyntheticDataset(SyntheticConfig(width=64, height=48))[0]"
    assert said(f"{rendered}; begin(1)") == ["threads 1 1 False"]


@pytest.mark.slow
def test_frames_rendered_after_other_arrays() -> None:
    """Nothing is said: only trackers are told of XLA's threads."""
    rendered = "from jaxslam.datasets.synthetic import *; SyntheticDataset(SyntheticConfig(width=64, height=48))[0]"
    (last,) = said(f"jnp.zeros(3).block_until_ready(); {rendered}", NPROC="2")
    assert last.startswith("threads 2")


def test_preferred_before_the_first_array() -> None:
    assert said("import jaxslam; jaxslam.prefer_one_thread(); jnp.zeros(3); begin(1)") == ["threads 1 1 False"]


@pytest.mark.parametrize(
    "opened",
    [
        pytest.param("datasets.synthetic import SyntheticDataset as Opened", marks=pytest.mark.slow),
        "worlds import WorldRecording as Opened",
    ],
)
@pytest.mark.slow
def test_a_rendered_recording_may_be_opened_first(opened: str) -> None:
    """As in the README: the recording, then the tracker of its camera."""
    name = "'flat'" if "worlds" in opened else ""
    assert said(f"from jaxslam.{opened}; Opened({name}); begin(1)") == ["threads 1 1 False"]


@pytest.mark.parametrize(
    ("before", "deterministic", "expected"),
    [(0.005, "false", 0.0002), (0.0001, "false", 0.0001), (0.005, "true", 0.005)],
)
def test_live_threads_give_way_soon(
    monkeypatch: pytest.MonkeyPatch, before: float, deterministic: str, expected: float
) -> None:
    now = [before]
    monkeypatch.setattr(sys, "getswitchinterval", lambda: now[0])
    monkeypatch.setattr(sys, "setswitchinterval", now.append)
    camera = Camera("small", width=64, height=64, fx=60.0, fy=60.0, cx=31.5, cy=31.5)
    Slam(camera, load_config(overrides=["semantics.model=null", f"run.deterministic={deterministic}"])).close()
    assert now[-1] == expected


def test_must_be_positive() -> None:
    with pytest.raises(ConfigError, match=r"run\.threads: expected .*, got 0"):
        load_config(overrides=["run.threads=0"])


@pytest.mark.parametrize(("setting", "expected"), [(None, 2), (1, 1)])
def test_network_has_as_many_unless_it_has_its_own(tmp_path: Path, setting: int | None, expected: int) -> None:
    model = tiny_models.yolox(tmp_path / "yolox.onnx", [])
    detector = detector_of(SemanticsConfig(model=str(model), threads=setting), num_threads=2)
    assert isinstance(detector, OnnxDetector)
    session = detector._network._session
    assert session.get_session_options().intra_op_num_threads == expected
