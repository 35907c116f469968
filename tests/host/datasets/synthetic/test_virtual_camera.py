"""The choice of what is rendered, in scenes of many solids."""

import numpy as np
import pytest

from jaxslam.datasets.synthetic import virtual_camera
from jaxslam.worlds import WorldRecording
from jaxslam.worlds.description import Road, Row, Way, World, WorldCamera

STREET = World(
    about="A street.",
    seconds=10.0,
    way=Way(along="street", speed_m_per_s=10.0, ends="stop"),
    roads={"street": Road(((0.0, 0.0), (120.0, 0.0), (120.0, 60.0)), rows=(Row(("house", "tree"), 6.0, 12.0),))},
    ground="grass",
    backdrop_m=300.0,
    camera=WorldCamera(width=320, height=180, fps=5.0, baseline_m=0.5),
)


@pytest.mark.slow
@pytest.mark.parametrize("index", [0, 20, 45])
def test_what_is_left_out_is_out_of_sight_or_tiny(monkeypatch, index):
    chosen = WorldRecording(STREET)
    frame = chosen.render(index)
    monkeypatch.setattr(virtual_camera, "_SMALL_SCENE", 100_000)
    every = WorldRecording(STREET)
    whole = every.render(index)
    assert len(every._built.static) > 512
    assert np.mean(frame.instance_mask != whole.instance_mask) < 1e-3
    assert np.mean(np.abs(frame.exact_depth_m - whole.exact_depth_m) > 1e-2) < 2e-3
    assert np.mean(frame.rgb != whole.rgb) < 1e-2


@pytest.mark.slow
def test_any_order_of_frames_gives_the_same_bytes():
    first, second = WorldRecording(STREET), WorldRecording(STREET)
    forward = [first.render(index).rgb for index in (0, 30)]
    backward = [second.render(index).rgb for index in (30, 0)]
    for one, other in zip(forward, reversed(backward), strict=True):
        np.testing.assert_array_equal(one, other)
