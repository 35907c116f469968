"""The platform of JAX: the commands compute on the CPU, and the tracker warns where it would not."""

import logging
import os
import subprocess
import sys

import jax
import pytest

from jaxslam.cli.command_table import COMMANDS
from jaxslam.runtime.platform_choice import environment_of_user, prefer_cpu, warn_unless_cpu

CHOOSE = "import jaxslam.runtime.platform_choice as p, os; p.prefer_cpu(); print(os.environ['JAX_PLATFORMS'])"


@pytest.mark.parametrize(("chosen", "expected"), [({}, "cpu"), ({"JAX_PLATFORMS": "cuda,cpu"}, "cuda,cpu")])
def test_cpu_is_chosen_unless_the_environment_names_a_platform(chosen: dict[str, str], expected: str) -> None:
    environment = {name: value for name, value in os.environ.items() if name != "JAX_PLATFORMS"} | chosen
    done = subprocess.run([sys.executable, "-c", CHOOSE], env=environment, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == expected


@pytest.mark.parametrize(("chosen", "expected"), [(None, None), ("cuda", "cuda")])
def test_other_programs_have_the_platform_of_the_user(
    monkeypatch: pytest.MonkeyPatch, chosen: str | None, expected: str | None
) -> None:
    """Also those that a process of ours starts, which has the choice from its parent."""
    monkeypatch.setattr(os, "environ", {"OTHER": "1"} | ({} if chosen is None else {"JAX_PLATFORMS": chosen}))
    monkeypatch.delitem(sys.modules, "jax")
    prefer_cpu()
    assert os.environ["JAX_PLATFORMS"] == (chosen or "cpu")
    prefer_cpu()
    assert environment_of_user() == {"OTHER": "1"} | ({} if expected is None else {"JAX_PLATFORMS": expected})


def test_a_process_that_has_jax_is_left_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("JAX_PLATFORMS", raising=False)
    prefer_cpu()
    assert "JAX_PLATFORMS" not in os.environ


def test_a_gpu_is_warned_of(monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING):
        warn_unless_cpu()
        assert not caplog.records
        monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
        warn_unless_cpu()
    assert "JAX computes on 'gpu'; expected 'cpu'" in caplog.text


def test_only_two_benchmarks_take_a_gpu() -> None:
    assert [command.name for command in COMMANDS if command.takes_gpu] == ["bench batch", "bench kernels"]
