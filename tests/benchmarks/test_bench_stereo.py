"""A stereo camera on a car, live at its rate, beside OpenCV's optical flow alone.

`pytest -m benchmark -n 0 tests/benchmarks/test_bench_stereo.py -s`
"""

from pathlib import Path

import numpy as np
import pytest
from benchmarks.live import live_run, part_of, show

pytestmark = [pytest.mark.benchmark, pytest.mark.usefixtures("opencv_in_one_thread")]

RUNS, NUM_PAIRS, RATE_HZ = 5, 51, 10.0


def test_pairs_take_twice_as_long_as_opencv_flow(data_dir: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Flow of 500 points of pairs of 1226x370, their depth, regions, the pose, and mapping in its threads."""
    part = part_of(data_dir / "kitti/sequences/06", range(NUM_PAIRS), RATE_HZ)
    runs = [live_run(part) for _ in range(RUNS)]
    show(capsys, "kitti/sequences/06", runs)
    assert np.median([run.median for run in runs]) <= 2.0
