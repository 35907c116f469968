"""Freed memory goes back to the system, where glibc would keep it, or is kept, where it would go back."""

import platform
import subprocess
import sys

import pytest

from jaxslam.runtime import freed_memory

SCRIPT = """
from jaxslam.runtime.freed_memory import return_freed_memory
from jaxslam.runtime.machine import rss_mb

pieces = [bytes(1000) for _ in range(200_000)]
pieces = pieces[::100]  # what is left stands in the way of giving back the rest
before = rss_mb()
return_freed_memory()
print(before - rss_mb())
"""


KEPT = """
import resource
import numpy as np
from jaxslam.runtime.freed_memory import keep_freed_memory

{call}
for _ in range(20):
    planes = [np.ones(110_000) for _ in range(20)]
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    del planes
    planes = [np.ones(110_000) for _ in range(20)]
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="only glibc keeps freed memory")
def test_most_of_it_is_returned() -> None:
    done = subprocess.run([sys.executable, "-c", SCRIPT], capture_output=True, text=True, check=True, timeout=60)
    assert float(done.stdout) > 100


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="only glibc learns what to keep")
def test_arrays_of_the_next_picture_take_the_memory_of_the_last() -> None:
    faults = []
    for call in ("pass", "keep_freed_memory()"):
        program = [sys.executable, "-c", KEPT.replace("{call}", call)]
        done = subprocess.run(program, capture_output=True, text=True, check=True, timeout=60)
        faults.append(int(done.stdout))
    assert faults[0] > 4000  # of 4297 pages
    assert faults[1] < 200


@pytest.mark.parametrize("system", ["darwin", "win32"])
def test_nothing_is_done_elsewhere(monkeypatch: pytest.MonkeyPatch, system: str) -> None:
    freed_memory._malloc_trim.cache_clear()
    monkeypatch.setattr(sys, "platform", system)
    freed_memory.return_freed_memory()
    assert freed_memory._malloc_trim() is None
    freed_memory._malloc_trim.cache_clear()
