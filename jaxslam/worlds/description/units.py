"""Types of fields that descriptions share, and checks of them."""

import itertools
from typing import Annotated, Literal, TypeAlias

from jaxslam.config.validation import Positive, Share
from jaxslam.errors import ConfigError

Color: TypeAlias = tuple[Annotated[float, Share], Annotated[float, Share], Annotated[float, Share]]
Length: TypeAlias = Annotated[float, Positive]
Plan: TypeAlias = tuple[float, float]
Point: TypeAlias = tuple[float, float, float]
Pose: TypeAlias = tuple[float, float, float, float, float, float, float]

Side: TypeAlias = Literal["north", "south", "east", "west"]
"""Walls of a room: north is towards +y, east towards +x."""

Ends: TypeAlias = Literal["back", "reverse", "loop", "stop"]
"""What happens at the last point of a way."""


def check_span(of: str, from_s: float, until_s: float | None) -> None:
    """Refuse a span of time that ends before it begins.

    Raises:
        ConfigError: If it does.
    """
    if until_s is not None and until_s <= from_s:
        raise ConfigError(f"{of}.until_s: expected more than from_s, {from_s}, got {until_s}")


def check_way(of: str, points: tuple[tuple[float, ...], ...], other: str | None, name: str) -> None:
    """Refuse a way with neither points nor something else that tells it, or with both.

    Raises:
        ConfigError: If it is one.
    """
    if other is None:
        check_points(f"{of}.points_m", points)
    elif points:
        raise ConfigError(f"{of}: expected points_m or {name}, got both")


def check_points(name: str, points: tuple[tuple[float, ...], ...]) -> None:
    """Refuse a way of fewer than two points, or with a point twice in a row.

    Raises:
        ConfigError: If it is one.
    """
    if len(points) < 2:
        raise ConfigError(f"{name}: expected at least two points, got {len(points)}")
    for first, second in itertools.pairwise(points):
        if first == second:
            raise ConfigError(f"{name}: expected different points in a row, got {first} twice")
