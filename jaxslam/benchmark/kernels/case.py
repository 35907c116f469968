"""Comparisons of kernels with other libraries."""

from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from typing import Any


@dataclass(frozen=True)
class Problem:
    """One problem of a certain size, and both ways to solve it.

    Attributes:
        ours: Function of arrays, which is not compiled yet.
        arguments: Arguments of `ours`.
        theirs: Function of the other library that does the same work.
        difference: Function that returns the difference of both results; infinite if the other library found none.
        prepare: Function that makes the arguments of `theirs` before each call, which is not timed.
        compile: Function that compiles the programs of `ours` if `ours` runs on the host and is called as it is.
    """

    ours: Callable[..., Any]
    arguments: tuple[Any, ...]
    theirs: Callable[..., Any]
    difference: Callable[[Any, Any], float]
    prepare: Callable[[], tuple[Any, ...]] = tuple
    compile: Callable[[], Any] | None = None


@dataclass(frozen=True)
class Case:
    """A kernel beside another library, over sizes.

    Attributes:
        name: Name of the kernel, and of the varied quantity if it is not the number of points.
        axis: Quantity that the size counts.
        sizes: Ascending sizes, evenly spaced on a logarithmic scale.
        reference: Function of the other library, as a user calls it.
        compared: Work that both sides do, in one sentence.
        difference: Measure of the difference between the two results, with its unit.
        limit: Largest normal difference.
        problem: Function that makes a problem of a size.
        packages: Packages that the reference needs besides jaxslam's own dependencies.
        label: Function that names a size.
    """

    name: str
    axis: str
    sizes: tuple[int, ...]
    reference: str
    compared: str
    difference: str
    limit: float
    problem: Callable[[int], Problem]
    packages: tuple[str, ...] = ()
    label: Callable[[int], str] = str

    def missing(self) -> str | None:
        """Return the first package that is not installed; `None` if all are."""
        return next((name for name in self.packages if installed(name) is None), None)


def installed(package: str) -> str | None:
    """Return the version of a package; `None` if it is not installed."""
    try:
        return version(package)
    except PackageNotFoundError:
        return None
