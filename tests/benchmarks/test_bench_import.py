"""What it costs to start: `import jaxslam` and `jaxslam --help` beside `import jax`, in processes in turn.

`pytest -m benchmark -n 0 tests/benchmarks/test_bench_import.py -s`
"""

import statistics
import subprocess
import sys
import time

import pytest

pytestmark = pytest.mark.benchmark

ROUNDS = 15
_REFERENCE = "import jax"
MOST = {"import jaxslam": 1.9, "from jaxslam.cli.entry_point import main; main(['--help'])": 0.6}
"""The most that each may take, in times of `import jax`."""


def seconds(code: str) -> float:
    """Wall time of a new process, from its start to its end."""
    began = time.perf_counter()
    subprocess.run([sys.executable, "-c", code], check=True, capture_output=True)
    return time.perf_counter() - began


def test_beside_jax() -> None:
    """Medians of processes in turn, so that whatever else the machine does meets all of them."""
    times: dict[str, list[float]] = {code: [] for code in (_REFERENCE, *MOST)}
    for code in times:
        seconds(code)  # compiled by Python, and in the memory of the system
    for _ in range(ROUNDS):
        for code, taken in times.items():
            taken.append(seconds(code))
    medians = {code: statistics.median(taken) for code, taken in times.items()}
    ratios = {code: medians[code] / medians[_REFERENCE] for code in MOST}
    print(f"\nimport jax: {medians[_REFERENCE]:.3f} s")
    for code, ratio in ratios.items():
        print(f"{code}: {medians[code]:.3f} s, {ratio:.2f} times")
    assert all(ratio <= MOST[code] for code, ratio in ratios.items()), ratios
