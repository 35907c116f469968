"""On what runs were made, in words: CPU, vector instructions, cores, and versions of the libraries that decide."""

from collections.abc import Mapping, Sequence
from typing import Any

_COMPILED_WITH = ("jax", "jaxlib", "jaxlie", "equinox", "optimistix")
_ROUNDING_LIBRARIES = ("jaxlib", "opencv-python-headless", "numpy")


def machine_of(results: Sequence[Mapping[str, Any]]) -> str:
    """CPU, vector instructions and cores of the machines on which runs were made."""
    return "; ".join(sorted({machine_name(result) for result in results if result["status"] == "done"}))


def machine_name(machine: Mapping[str, Any]) -> str:
    """CPU, vector instructions and cores of one machine, as `jaxslam.runtime.machine.machine` or a result has them."""
    return f"{cpu_name(machine)}, {machine['cores']} cores"


def cpu_name(machine: Mapping[str, Any]) -> str:
    """CPU and vector instructions of one machine: what decides how figures are rounded."""
    return f"{machine['cpu']} ({machine['vectors']})"


def versions_of(results: Sequence[Mapping[str, Any]]) -> str:
    """Versions of the libraries that round, with which runs were made."""
    done = (result["versions"] for result in results if result["status"] == "done")
    return "; ".join(sorted({", ".join(f"{name} {of_run[name]}" for name in _ROUNDING_LIBRARIES) for of_run in done}))


def compiled_with(machine: Mapping[str, Any]) -> str:
    """Versions of the libraries that decide which programs are compiled, and how."""
    return ", ".join(f"{name} {machine['versions'][name]}" for name in _COMPILED_WITH)
