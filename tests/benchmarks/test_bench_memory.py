"""Memory over ten thousand frames. Run alone: `pytest -m benchmark -n 0`."""

import sys

import pytest
from small_scene import CONFIG, clip, resident_mb, track_round_trip

from jaxslam.slam.slam import Slam


@pytest.mark.benchmark
@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_ten_thousand_steps_are_flat() -> None:
    slam, frames = Slam(clip().camera, CONFIG), clip().frames
    track_round_trip(slam, frames, 1_000)
    before = resident_mb()
    track_round_trip(slam, frames, 10_000)
    print(f"\nresident after 1,000 steps {before:.1f} MB, after 10,000 more {resident_mb():.1f} MB")
    assert resident_mb() < 1.02 * before
