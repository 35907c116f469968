"""Compiler options: what a release of XLA does not know is left out, and said."""

import logging

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxslam.runtime import compiler_options
from jaxslam.runtime.compiled import compiled
from jaxslam.runtime.compiler_options import FAST_COMPILE, FUSION_EMITTERS, SINGLE_THREAD, known_options

DROPPED: dict[str, bool | str] = {"xla_cpu_option_of_another_release": True}


@compiled(when="first use", static="times", options=DROPPED | SINGLE_THREAD)
def scaled(x: jax.Array, times: int) -> jax.Array:
    """Scale an array."""
    return x * times


def test_leaves_out_what_xla_does_not_know(caplog: pytest.LogCaptureFixture) -> None:
    compiler_options._is_known.cache_clear()  # another test may have been first
    with caplog.at_level(logging.INFO, logger="jaxslam"):
        for _ in range(2):
            assert known_options(DROPPED | SINGLE_THREAD) == SINGLE_THREAD
    (logged,) = [record.getMessage() for record in caplog.records if record.name.startswith("jaxslam")]
    assert "no compiler option xla_cpu_option_of_another_release" in logged


@pytest.mark.parametrize("options", [FAST_COMPILE, FUSION_EMITTERS, SINGLE_THREAD])
def test_xla_knows_ours(options: dict[str, bool | str]) -> None:
    """Users hand `FAST_COMPILE` to `jax.jit` themselves."""
    assert known_options(options) == options


def test_a_program_with_an_unknown_option_runs() -> None:
    np.testing.assert_array_equal(scaled(jnp.arange(3.0), times=2), [0.0, 2.0, 4.0])
    assert scaled.__name__ == "scaled"
    assert scaled.__doc__ == "Scale an array."


def test_a_wrong_value_is_an_error() -> None:
    with pytest.raises(jax.errors.JaxRuntimeError):
        known_options({"xla_cpu_scheduler_type": "CPU_SCHEDULER_OF_NOBODY"})
