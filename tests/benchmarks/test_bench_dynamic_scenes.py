"""NGD-SLAM in the rendered room, one to four people before four camera paths: true masks at once, late, and none.

`pytest -m benchmark -n 0 tests/benchmarks/test_bench_dynamic_scenes.py -s`; some fifteen minutes on one core.
"""

import itertools
import math

import pytest
from dynamic_scenes import PATHS, errors, scene

from jaxslam.datasets.synthetic import SyntheticConfig

pytestmark = pytest.mark.benchmark

FRAMES, PEOPLE, DILATIONS_PX = 90, (1, 2, 3, 4), (3, 4, 5)
LATE_RATIO, STATIC_RATIO = 1.3, 5.0


def test_late_masks_are_as_good_in_all_scenes(capsys: pytest.CaptureFixture[str]) -> None:
    """A scene is hard if `static` is five times worse than masks at once; half of them are, and all that turn."""
    found = {}
    with capsys.disabled():
        print("\npath       people  covered    static  at once     late")
        for path, people in itertools.product(PATHS, PEOPLE):
            one = scene(SyntheticConfig(frames=FRAMES, path=path, people=people))
            found[path, people] = result = errors(one, dilations_px=DILATIONS_PX)
            print(f"{path:10s} {people:6d} {100 * one.share:6.0f} % {result}", flush=True)
        mean = math.exp(sum(math.log(result.late_ratio) for result in found.values()) / len(found))
        hard = [key for key, result in found.items() if result.static_ratio >= STATIC_RATIO]
        print(
            f"late / at once: geometric mean {mean:.2f}; static five times worse in {len(hard)} of {len(found)} scenes"
        )
    assert {key: result.late_ratio for key, result in found.items() if result.late_ratio > LATE_RATIO} == {}
    assert len(hard) >= len(found) // 2
    assert {("rpy", people) for people in PEOPLE} <= set(hard)
