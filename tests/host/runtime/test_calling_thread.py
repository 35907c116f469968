"""Programs of tracking, mapping and rendering compute in the threads that call them, not in XLA's pool.

The pool has one thread, in which the pose of a frame would wait for a bundle adjustment: up to 35 of 40 ms. Parts of a
rendered picture would wait there for each other: 190 ms a stereo pair of a road instead of 118.
"""

import os
import sys
import time
from pathlib import Path

import pytest

from jaxslam.config.loading import load_config
from jaxslam.datasets.synthetic import SyntheticConfig, SyntheticDataset
from jaxslam.slam.slam import Slam
from jaxslam.worlds import WorldRecording

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")

_POOL = "tf_XLAEigen"
"""Beginning of the name that XLA gives to the threads of its pool."""


def pool_s() -> float:
    """Processor time that the threads of XLA's pool have taken so far, in seconds."""
    ticks = []
    for thread in Path("/proc/self/task").iterdir():
        try:
            name, numbers = (thread / "stat").read_text().split("(", 1)[1].rsplit(")", 1)
        except (FileNotFoundError, ProcessLookupError):
            continue  # it has ended; the pool does not
        if name.startswith(_POOL):
            ticks.append(sum(map(int, numbers.split()[11:13])))
    assert ticks, f"expected threads named {_POOL}..., got none"
    return sum(ticks) / os.sysconf("SC_CLK_TCK")


def test_tracking_and_mapping_leave_the_pool_alone() -> None:
    room = SyntheticDataset(SyntheticConfig(frames=60, path="rpy"))
    frames = [room[index] for index in range(0, 60, 3)]
    config = load_config("default", None, ["run.deterministic=true", "semantics.model=null"])
    with Slam(room.camera, config) as slam:
        slam.warm_up()
        began, pool_began_s = time.process_time(), pool_s()
        for frame in frames:
            slam.track(frame)
        slam.finish()
        took_s, in_pool_s = time.process_time() - began, pool_s() - pool_began_s
        assert len(slam.map.ids) >= 3  # some were adjusted
    assert in_pool_s < 0.1 * took_s


@pytest.mark.parametrize("world", ["flat", pytest.param("road", marks=pytest.mark.slow)])
def test_rendering_leaves_the_pool_alone(world: str) -> None:
    recording = WorldRecording(world)
    indices = range(0, len(recording), len(recording) // 8)
    for index in indices:  # what they need is compiled
        recording.render(index)
    began, pool_began_s = time.process_time(), pool_s()
    for index in indices:
        recording.render(index)
    assert pool_s() - pool_began_s < 0.1 * (time.process_time() - began)
