"""Describe the machine and software of this process: package versions, processor, peak memory, jaxslam commit."""

import platform
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path
from typing import Any

import psutil

from jaxslam import __version__
from jaxslam.runtime.threads import threads, usable_cores

_PACKAGES = ("jax", "jaxlib", "jaxlie", "equinox", "optimistix", "numpy", "opencv-python-headless")


def machine() -> dict[str, Any]:
    """Return the package versions, the processor, the cores and threads of this process, and the jaxslam commit."""
    return {
        "versions": {
            "python": platform.python_version(),
            "jaxslam": __version__,  # a checkout that is not installed has no metadata
            **{name: version(name) for name in _PACKAGES},
        },
        "cpu": cpu_model(),
        "vectors": _vectors(),
        "cores": usable_cores(),
        "threads": threads(),
        "commit": _commit(),
    }


def rss_mb() -> float:
    """Return the resident memory of this process, megabytes."""
    return psutil.Process().memory_info().rss / 1e6


def peak_rss_mb() -> float:
    """Return the peak resident memory of this process, megabytes."""
    if sys.platform == "win32":
        return psutil.Process().memory_info().peak_wset / 1e6
    status = Path("/proc/self/status")
    if status.is_file():
        # Not `getrusage`: on Linux a process begins there with the peak of the one that started it.
        told = dict(line.split(":", 1) for line in status.read_text().splitlines())
        if "VmHWM" in told:
            return int(told["VmHWM"].split()[0]) * 1024 / 1e6
    import resource  # noqa: PLC0415 - POSIX only

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (1e6 if sys.platform == "darwin" else 1e3)  # bytes there, kilobytes elsewhere


def cpu_model() -> str:
    """Return the name of the processor, or its architecture if the system does not report a name.

    A virtual machine may hide the model ("AMD EPYC"); family and model numbers are added to such a name.
    """
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.is_file() else []
    told = {name.strip(): value.strip() for name, _, value in (line.partition(":") for line in reversed(lines))}
    if "model name" not in told:
        return platform.processor() or platform.machine()
    name = told["model name"]
    if any(letter.isdigit() for letter in name) or not {"cpu family", "model"} <= told.keys():
        return name
    return f"{name} family {told['cpu family']} model {told['model']}"


def _vectors() -> str:
    """Return the widest vector instruction set of the processor, or its architecture if the flags are unknown.

    Rounding and speed depend on it.
    """
    info = Path("/proc/cpuinfo")
    flags = set(info.read_text().split()) if info.is_file() else set()
    return next((name for name in ("avx512f", "avx2", "avx", "sse4_2") if name in flags), platform.machine())


def _commit() -> str | None:
    """Return the commit of the checkout, with `+` appended if it has changes; `None` outside a checkout."""
    root = Path(__file__).resolve().parents[2]
    if not (root / ".git").exists():
        return None

    def git(*words: str) -> str:
        return subprocess.run(
            ["git", "-C", str(root), *words], capture_output=True, text=True, check=True
        ).stdout.strip()

    try:
        return git("rev-parse", "HEAD") + ("+" if git("status", "--porcelain", "--untracked-files=no") else "")
    except (OSError, subprocess.CalledProcessError):
        return None
