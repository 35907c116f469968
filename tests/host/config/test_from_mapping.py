"""Validated dataclasses built from what a file holds."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, ClassVar

import pytest

from jaxslam.config.catalog import CatalogEntry, read_catalog
from jaxslam.config.validation import Range, ValidatedConfig, from_mapping
from jaxslam.errors import CameraError, DatasetError, JaxSlamError


@dataclass(frozen=True)
class Inner(ValidatedConfig):
    number: Annotated[float, Range(above=0)]


@dataclass(frozen=True)
class Outer(ValidatedConfig):
    """Raises another class of errors than `Inner`."""

    _error: ClassVar[type[JaxSlamError]] = CameraError

    one: Inner
    some: tuple[Inner, ...] = ()
    named: Mapping[str, Inner] = field(default_factory=dict)
    maybe: Inner | None = None
    rest: Any = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if len(self.some) > 2:
            raise CameraError("some: expected two at most")


def test_nested() -> None:
    given = {"one": {"number": 1}, "some": [{"number": 2}], "named": {3: {"number": 3}}, "maybe": None, "rest": [1]}
    built = from_mapping(Outer, given, "f")
    assert built == Outer(Inner(1.0), (Inner(2.0),), {"3": Inner(3.0)}, None, [1])
    assert from_mapping(Outer, {"one": Inner(1)}, "f").one == Inner(1)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ([1], "f: expected `key: value` lines, got [1]"),
        ({}, "f: missing 'one'"),
        ({"one": {"number": 1}, "sme": []}, "f: unknown key 'sme' (did you mean 'some'?)"),
        ({"one": None}, "f: one: expected `key: value` lines, got None"),
        ({"one": {"number": -1}}, "f: one: number: expected a finite number > 0, got -1"),
        ({"one": {"number": 1}, "some": 3}, "f: some: expected a list, each a Inner, got 3"),
        ({"one": {"number": 1}, "some": [{}]}, "f: some[0]: missing 'number'"),
        ({"one": {"number": 1}, "named": {"x": {"number": "y"}}}, "f: named: x: number: expected a finite number > 0"),
        ({"one": {"number": 1}, "some": [{"number": 1}] * 3}, "f: some: expected two at most"),
    ],
)
def test_errors_are_of_the_outer_class(content: object, message: str) -> None:
    with pytest.raises(CameraError) as error:
        from_mapping(Outer, content, "f")
    assert str(error.value).startswith(message)


@dataclass(frozen=True, kw_only=True)
class Entry(CatalogEntry):
    _error: ClassVar[type[JaxSlamError]] = DatasetError

    file: str


def test_catalog(tmp_path: Path) -> None:
    """A group's fields hold for its entries, which may replace them; texts may hold the name."""
    path = tmp_path / "c.yaml"
    path.write_text(
        "- {license: A, page: p, about: a, url: 'https://x/{name}.zip', file: '{name}.f', entries:"
        " {b: {}, c: {license: B, file: f}}}"
    )
    found = read_catalog(Entry, "entries", path)
    assert [(e.name, e.license, e.url, e.file) for e in found.values()] == [
        ("b", "A", "https://x/b.zip", "b.f"),
        ("c", "B", "https://x/c.zip", "f"),
    ]
