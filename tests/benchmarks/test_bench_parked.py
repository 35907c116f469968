"""A box that stands for five seconds, is pushed for five, and stands again, in twenty rendered rooms.

`pytest -m benchmark -n 0 tests/benchmarks/test_bench_parked.py -s`; some twenty minutes on one core.
"""

import numpy as np
import pytest
from parked_object import WITHIN, verdicts

pytestmark = pytest.mark.benchmark

SEEDS, RIGHT = range(20), 0.95


def test_changes_are_known_soon(capsys: pytest.CaptureFixture[str]) -> None:
    after: list[int | None] = []
    with capsys.disabled():
        print("\nseed  frames until each change is known  wrong later  ATE")
        for seed in SEEDS:
            found = verdicts(seed)
            frames = [found.known_after(change) for change in found.changes()]
            error_mm = 1e3 * np.sqrt(np.mean(found.error_m**2))
            print(f"{seed:4d}  {frames!s:35s}  {100 * found.wrong_share(WITHIN):8.1f} %  {error_mm:.1f} mm", flush=True)
            after += frames
        in_time = [frames is not None and frames <= WITHIN for frames in after]
        print(f"right within {WITHIN} frames: {sum(in_time)} of {len(in_time)}")
    assert len(in_time) == 2 * len(SEEDS)
    assert np.mean(in_time) >= RIGHT
