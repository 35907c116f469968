"""Gradient through a clip of 150 frames, by all parameters of the tracker: time beside forward, and memory.

`pytest -m benchmark -n 0 tests/benchmarks/test_bench_rollout_gradient.py -s`
"""

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxslam import FAST_COMPILE, init_state, load_config, rollout, stack_frames, track_params, track_plan
from jaxslam.datasets.synthetic import SyntheticConfig, SyntheticDataset

_STATUS, _CLEAR = Path("/proc/self/status"), Path("/proc/self/clear_refs")
pytestmark = [
    pytest.mark.benchmark,
    pytest.mark.skipif(not _CLEAR.exists(), reason="needs the high-water mark of memory of Linux"),
]
NUM_FRAMES, WIDTH, HEIGHT = 150, 320, 240


def _mb(field: str) -> float:
    """Memory of this process: `VmRSS` now, `VmHWM` at most since the mark was cleared."""
    (line,) = (line for line in _STATUS.read_text().splitlines() if line.startswith(field))
    return int(line.split()[1]) / 1e3


def _run(program: Callable[..., Any], *arguments: Any) -> tuple[Any, float, float]:
    """Run a program; its result, seconds, and the most memory that it takes on top of what was held before, MB."""
    _CLEAR.write_text("5")  # else compiling, which takes more, would be what is measured
    before, began = _mb("VmRSS"), time.perf_counter()
    result = jax.block_until_ready(program(*arguments))
    return result, time.perf_counter() - began, _mb("VmHWM") - before


def test_gradient_by_all_parameters() -> None:
    config = load_config()
    room: Any = SyntheticDataset(SyntheticConfig(frames=NUM_FRAMES, width=WIDTH, height=HEIGHT))
    plan, params = track_plan(config.track), track_params(room.camera, config.track)
    clip = jax.tree.map(jnp.asarray, stack_frames(room))
    state = init_state(HEIGHT, WIDTH, plan)

    def length(params: Any, state: Any, clip: Any) -> Any:
        """Sum of squared positions: every pose counts."""
        return jnp.sum(jnp.square(rollout(state, clip, params, plan)[1].T_world_cam.translation()))

    programs = [
        jax.jit(function, compiler_options=FAST_COMPILE).lower(params, state, clip).compile()
        for function in (length, jax.grad(length))
    ]
    figures = [[_run(program, params, state, clip) for program in programs] for _ in range(2)]
    (_, forward_s, forward_mb), (gradient, gradient_s, _) = figures[1]
    gradient_mb = figures[0][1][2]  # before any memory is held for the next time
    print(f"\n{NUM_FRAMES} frames of {WIDTH}x{HEIGHT}: forward {forward_s:.2f} s, {forward_mb:.0f} MB more than before")
    print(f"gradient by {len(jax.tree.leaves(gradient))} arrays: {gradient_s:.2f} s, {gradient_mb:.0f} MB more")
    print(f"  {gradient_s / forward_s:.2f} times the time of forward")
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradient))
    assert np.count_nonzero([np.any(leaf != 0) for leaf in jax.tree.leaves(gradient)]) > 8
    assert gradient_mb < 2000
    assert gradient_s < 8 * forward_s
