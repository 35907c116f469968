"""What a comparison of a kernel with another library consists of."""

from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from typing import Any


@dataclass(frozen=True)
class Problem:
    """One problem of a certain size, and both ways to solve it.

    Attributes:
        ours: A function of arrays, not compiled but for `compile`.
        arguments: What it is called with.
        theirs: The same work by another library.
        difference: How far the two results are apart, given both; infinite if theirs is none.
        prepare: Makes what theirs is called with, anew for each call, not timed.
        compile: Compiles what ours needs, where that works on the host and is called as it is.
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
        name: Of the kernel, and of what is varied where that is not its number of points.
        axis: What the size counts.
        sizes: From small to large, evenly spread on a logarithmic scale.
        reference: What does the same work, as a user calls it.
        compared: What is done on both sides, in one sentence.
        difference: What is measured of two results to see that they are the same, with its unit.
        limit: How much of that is normal.
        problem: Makes one of a size.
        packages: What has to be installed for the reference beside jaxslam's own dependencies.
        label: What a size is called.
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
        """The first of the packages that is not installed."""
        return next((name for name in self.packages if installed(name) is None), None)


def installed(package: str) -> str | None:
    """The version of a package, `None` if it is not installed."""
    try:
        return version(package)
    except PackageNotFoundError:
        return None
