"""What a process says of the machine it runs on, on every system."""

import subprocess
import sys

from jaxslam.runtime.machine import cpu_model, machine, peak_rss_mb
from jaxslam.runtime.threads import threads, usable_cores


def test_machine_is_told() -> None:
    told = machine()
    assert told["cpu"] == cpu_model() != ""
    assert (told["cores"], told["threads"]) == (usable_cores(), threads())
    assert told["versions"]["python"] == sys.version.split()[0]
    assert set(told["versions"]) > {"jaxslam", "jax", "jaxlib", "numpy"}


def test_memory_is_the_most_there_was() -> None:
    """In megabytes: what is written and given back stays in the figure."""
    before = peak_rss_mb()
    assert 20 < before < 1e5
    block = bytearray(b"x") * 200_000_000
    after = peak_rss_mb()
    del block
    assert after >= max(before, 200)
    assert peak_rss_mb() >= 0.99 * after  # Linux counts pages on each core, and adds them up now and then


def test_memory_is_that_of_the_process_itself() -> None:
    """Not of the one that started it, as `getrusage` says on Linux."""
    block = bytearray(b"x") * 1_000_000_000
    code = "from jaxslam.runtime.machine import peak_rss_mb; print(peak_rss_mb())"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert len(block) == 1_000_000_000
    assert 5 < float(done.stdout) < 900
