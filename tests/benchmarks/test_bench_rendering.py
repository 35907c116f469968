"""Time and memory of rendering worlds.

`pytest -m benchmark -n 0 tests/benchmarks/test_bench_rendering.py -s`
"""

import sys
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from multiprocessing import get_context

import numpy as np
import pytest
from small_scene import resident_mb

from jaxslam.worlds import WorldRecording
from jaxslam.worlds.description import WorldCamera
from jaxslam.worlds.library import load_world

pytestmark = pytest.mark.benchmark


def times_ms(name: str, frames: int) -> np.ndarray:
    """Wall and processor times of frames from everywhere in a world, `(2, frames)` ms."""
    recording = WorldRecording(name)
    indices = np.linspace(0, len(recording) - 1, frames).astype(int).tolist()
    for index in indices[:: frames // 8]:  # what they need is compiled
        recording.render(index)
    clocks = (time.perf_counter, time.process_time)
    times = []
    for index in indices:
        began = [clock() for clock in clocks]
        recording.render(index)
        times.append([1e3 * (clock() - start) for clock, start in zip(clocks, began, strict=True)])
    return np.transpose(times)


@pytest.mark.parametrize(("name", "frames"), [("flat", 60), ("road", 40)])
def test_frames_from_everywhere(name: str, frames: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("NPROC", raising=False)  # all cores, as `jaxslam world render` has them
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as process:
        wall, cpu = process.submit(times_ms, name, frames).result()
    median, p95 = np.percentile(wall, [50, 95])
    camera = load_world(name).camera
    print(
        f"\n{name}, {camera.width}x{camera.height}: median {median:.0f} ms a frame, p95 {p95:.0f};"
        f" processor time {np.median(cpu):.0f} ms"
    )


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_two_thousand_frames_take_no_more_memory() -> None:
    recording = WorldRecording(replace(load_world("flat"), camera=WorldCamera(width=160, height=120)))
    for index in range(0, 2000, 100):
        recording.render(index)
    before_mb = resident_mb()
    for index in range(2000):
        recording.render(index)
    print(f"\n2,000 frames of 160x120: {resident_mb() - before_mb:+.1f} MB")
    assert resident_mb() < before_mb + 50.0
