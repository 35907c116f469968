"""What cues to what moves add to a frame: their time as a share of OpenCV's optical flow of a frame.

`pytest -m benchmark -n 0 tests/benchmarks/test_bench_cues.py -s`
"""

import pytest

from jaxslam.benchmark.kernels.measure import devices, measure
from jaxslam.benchmark.kernels.registry import CASES

pytestmark = pytest.mark.benchmark

ROUNDS = 100


@pytest.mark.parametrize(
    ("name", "num_points", "most"),
    [("cue_clusters", 512, 0.35), ("cue_epipolar_trajectory", 512, 0.2), ("cue_occlusion", 1000, 0.1)],
)
def test_share_of_a_frame(name: str, num_points: int, most: float) -> None:
    row = measure(CASES[name], num_points, devices()[0], ROUNDS)
    print(f"\n{name}, {num_points} points: ours {row['ours_ms']:.2f} ms, OpenCV's flow {row['theirs_ms']:.2f} ms,")
    print(f"  ratio {row['ratio']:.3f}, of processor time {row['processor_ratio']:.3f}, at most {most:g} wanted")
    print(f"  {CASES[name].difference}: {row['difference']:.3f}")
    assert row["agrees"]
    assert row["processor_ratio"] <= most
