"""All kernels that are compared with other libraries, and the cues that are made of them."""

from collections.abc import Sequence

from jaxslam.benchmark.kernels.case import Case, installed
from jaxslam.benchmark.kernels.cue_cases import CUE_CASES
from jaxslam.benchmark.kernels.graph_cases import GRAPH_CASES
from jaxslam.benchmark.kernels.image_cases import IMAGE_CASES
from jaxslam.benchmark.kernels.point_cases import POINT_CASES
from jaxslam.benchmark.kernels.pose_cases import POSE_CASES
from jaxslam.benchmark.kernels.two_view_cases import TWO_VIEW_CASES
from jaxslam.errors import BenchmarkError, nearest

CASES: dict[str, Case] = {
    case.name: case for case in (*IMAGE_CASES, *POSE_CASES, *TWO_VIEW_CASES, *GRAPH_CASES, *POINT_CASES, *CUE_CASES)
}


def versions() -> dict[str, str | None]:
    """Versions of the libraries that jaxslam is compared with, beyond those that every run names."""
    names = dict.fromkeys(("scipy", *(name for case in CASES.values() for name in case.packages)))
    return {name: installed(name) for name in names}


def chosen(names: Sequence[str]) -> list[Case]:
    """The kernels of these names, each once, or all of them if there are no names.

    Raises:
        BenchmarkError: If there is none of a name.
    """
    for name in names:
        if name not in CASES:
            raise BenchmarkError(f"--only: unknown kernel '{name}'{nearest(name, CASES)}")
    return [case for name, case in CASES.items() if not names or name in names]
