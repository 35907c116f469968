"""Freed memory goes back to the system, where glibc would keep it."""

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


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="only glibc keeps freed memory")
def test_most_of_it_is_returned() -> None:
    done = subprocess.run([sys.executable, "-c", SCRIPT], capture_output=True, text=True, check=True, timeout=60)
    assert float(done.stdout) > 100


@pytest.mark.parametrize("system", ["darwin", "win32"])
def test_nothing_is_done_elsewhere(monkeypatch: pytest.MonkeyPatch, system: str) -> None:
    freed_memory._malloc_trim.cache_clear()
    monkeypatch.setattr(sys, "platform", system)
    freed_memory.return_freed_memory()
    assert freed_memory._malloc_trim() is None
    freed_memory._malloc_trim.cache_clear()
