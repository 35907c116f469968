"""Frozen dataclasses that check the type and range of every field when they are built."""

import dataclasses
import functools
import math
import numbers
import reprlib
import types
from collections.abc import Callable, Mapping
from dataclasses import MISSING, dataclass
from typing import Annotated, Any, ClassVar, Literal, TypeAlias, TypeVar, Union, get_args, get_origin, get_type_hints

from jaxslam.errors import ConfigError, JaxSlamError
from jaxslam.io.yaml_files import check_keys, checked_mapping

_Args: TypeAlias = tuple[Any, ...]
_PLAIN: dict[Any, str] = {int: "an integer", float: "a finite number", bool: "true or false", str: "text"}


@dataclass(frozen=True)
class Range:
    """Range of numbers that a field accepts, as in `Annotated[float, Range(above=0, at_most=1)]`."""

    at_least: float | None = None
    """Smallest accepted number."""
    at_most: float | None = None
    """Largest accepted number."""
    above: float | None = None
    """Exclusive lower bound."""
    below: float | None = None
    """Exclusive upper bound."""
    multiple_of: int | None = None
    """Divisor of every accepted number."""

    def __contains__(self, value: float) -> bool:
        return (
            (self.at_least is None or value >= self.at_least)
            and (self.at_most is None or value <= self.at_most)
            and (self.above is None or value > self.above)
            and (self.below is None or value < self.below)
            and (self.multiple_of is None or value % self.multiple_of == 0)
        )

    def __str__(self) -> str:
        bounds = ((">=", self.at_least), (">", self.above), ("<=", self.at_most), ("<", self.below))
        parts = [f"{sign} {bound:g}" for sign, bound in bounds if bound is not None]
        return " and ".join(parts if self.multiple_of is None else [*parts, f"a multiple of {self.multiple_of}"])


Positive = Range(above=0)
Share = Range(at_least=0, at_most=1)


@dataclass(frozen=True)
class ValidatedConfig:
    """Base class of dataclasses that refuse a field of the wrong type or out of range, however they are built.

    Annotations may be `int`, `float`, `bool`, `str`, `Any`, `Literal`, `tuple`, `Mapping`, another dataclass, a union
    of these or `None`, each optionally `Annotated` with a `Range`. Where the annotation says so, lists become tuples
    and integers become floats, so that equal settings compare and hash equal.
    """

    _error: ClassVar[type[JaxSlamError]] = ConfigError
    """Class of the error raised for a wrong field; derived classes may replace it."""

    def __post_init__(self) -> None:
        for name, hint in field_hints(type(self)).items():
            value = checked_value(hint, getattr(self, name), f"{type(self).__name__}.{name}", self._error)
            object.__setattr__(self, name, value)


_Record = TypeVar("_Record", bound=ValidatedConfig)


class _MismatchError(ValueError):
    """A value does not fit its annotation. This error never leaves the module."""


@functools.cache
def field_hints(cls: type) -> dict[str, Any]:
    """List the annotations of a dataclass's fields, in order, with their `Annotated` metadata."""
    hints = get_type_hints(cls, include_extras=True)
    return {field.name: hints[field.name] for field in dataclasses.fields(cls)}


def checked_value(hint: Any, value: object, key: str, error: type[JaxSlamError] = ConfigError) -> Any:
    """Check a value against its annotation and convert it.

    Args:
        hint: The field's annotation.
        value: The value given in a file, on a command line or in code.
        key: Name of the field for the message, such as `track.num_points`.
        error: Class of the error to raise.

    Returns:
        The value, with lists converted to tuples and integers to floats where the annotation says so.

    Raises:
        JaxSlamError: An error of class `error`, if the value has the wrong type or is out of range.
    """
    try:
        return _converted(hint, value)
    except _MismatchError:
        raise error(f"{key}: expected {_expected(hint)}, got {reprlib.repr(value)}") from None


def from_mapping(cls: type[_Record], content: object, place: str) -> _Record:
    """Build a validated dataclass from what a file holds, together with the dataclasses in its fields.

    Args:
        cls: The class to build.
        content: A mapping from names of fields to their values. A field that is a dataclass, or a list or mapping of
            dataclasses, is given as a mapping, or as lists or mappings of mappings.
        place: File and section that the content comes from, as errors name it.

    Raises:
        JaxSlamError: An error of the class that `cls` raises, if the content is no mapping, a key is unknown or
            missing, or a value has the wrong type or is out of range. The message names the place, the key, what was
            expected and what was given.
    """
    return _record(cls, content, place, cls._error)


def section_of(hint: Any) -> type[Any] | None:
    """Find the dataclass in an annotation such as `X` or `X | None`; `None` if there is none."""
    choices = get_args(hint) if get_origin(hint) in (Union, types.UnionType) else (hint,)
    return next((c for c in choices if isinstance(c, type) and dataclasses.is_dataclass(c)), None)


def _record(cls: type[_Record], content: object, place: str, error: type[JaxSlamError]) -> _Record:
    given, hints = checked_mapping(content, place, error), field_hints(cls)
    fields = dataclasses.fields(cls)
    needed = [field.name for field in fields if field.default is MISSING and field.default_factory is MISSING]
    check_keys(given, hints, needed, place, error)
    values = {key: _built(hints[key], value, f"{place}: {key}", error) for key, value in given.items()}
    try:
        return cls(**values)
    except JaxSlamError as problem:
        raise error(f"{place}: {problem}") from None


def _built(hint: Any, value: object, place: str, error: type[JaxSlamError]) -> Any:
    """Check the value of a field as `checked_value` does, and build the dataclasses in it."""
    section, args = section_of(hint), get_args(hint)
    if section is not None and not (dataclasses.is_dataclass(value) or (value is None and args)):
        return _record(section, value, place, error)
    if get_origin(hint) is tuple and args[-1] is Ellipsis and isinstance(value, list | tuple):
        return tuple(_built(args[0], item, f"{place}[{index}]", error) for index, item in enumerate(value))
    if get_origin(hint) is Mapping:
        given = checked_mapping(value, place, error)
        return {key: _built(args[1], item, f"{place}: {key}", error) for key, item in given.items()}
    return checked_value(hint, value, place, error)


def _converted(hint: Any, value: object) -> Any:
    if convert := _CONVERTERS.get(get_origin(hint)):
        return convert(get_args(hint), value)
    if hint is Any:
        return value
    if hint in _PLAIN:
        return _plain(hint, value)
    if isinstance(hint, type) and (hint is types.NoneType or dataclasses.is_dataclass(hint)):
        return _require(value, isinstance(value, hint))
    raise TypeError(f"no check for fields annotated {hint!r}")


def _require(value: object, fits: bool) -> Any:
    if not fits:
        raise _MismatchError
    return value


def _in_ranges(args: _Args, value: object) -> Any:
    converted = _converted(args[0], value)
    ranges = [item for item in args[1:] if isinstance(item, Range)]
    return _require(converted, converted is None or all(converted in item for item in ranges))


def _choice(args: _Args, value: object) -> Any:
    return _require(value, any(value == choice and type(value) is type(choice) for choice in args))


def _first_that_fits(args: _Args, value: object) -> Any:
    for hint in args:
        try:
            return _converted(hint, value)
        except _MismatchError:
            continue
    raise _MismatchError


def _tuple(args: _Args, value: object) -> tuple[Any, ...]:
    if not isinstance(value, list | tuple):
        raise _MismatchError
    hints = args[:1] * len(value) if args[-1] is Ellipsis else args
    _require(value, len(value) == len(hints))
    return tuple(_converted(hint, item) for hint, item in zip(hints, value, strict=True))


def _mapping(args: _Args, value: object) -> dict[Any, Any]:
    if not isinstance(value, Mapping):
        raise _MismatchError
    return {_converted(args[0], key): _converted(args[1], item) for key, item in value.items()}


_CONVERTERS: dict[Any, Callable[[_Args, object], Any]] = {
    Annotated: _in_ranges,
    Literal: _choice,
    Union: _first_that_fits,
    types.UnionType: _first_that_fits,
    tuple: _tuple,
    Mapping: _mapping,
}


def _plain(hint: type, value: object) -> Any:
    if hint in (bool, str):
        return _require(value, isinstance(value, hint))
    kind = numbers.Real if hint is float else numbers.Integral
    if isinstance(value, bool) or not isinstance(value, kind):
        raise _MismatchError
    try:
        number = hint(value)
    except OverflowError:
        raise _MismatchError from None
    return _require(number, hint is int or math.isfinite(number))


def _expected(hint: Any) -> str:
    args = get_args(hint)
    if describe := _DESCRIPTIONS.get(get_origin(hint)):
        return describe(args)
    if hint is Any:
        return "any value"
    return _PLAIN.get(hint) or ("null" if hint is types.NoneType else f"a {hint.__name__}")


def _expected_range(args: _Args) -> str:
    return " ".join([_expected(args[0]), *(str(item) for item in args[1:] if isinstance(item, Range))])


def _expected_list(args: _Args) -> str:
    if args[-1] is Ellipsis:
        return f"a list, each {_expected(args[0])}"
    return f"a list of {len(args)}: " + ", ".join(map(_expected, args))


_DESCRIPTIONS: dict[Any, Callable[[_Args], str]] = {
    Annotated: _expected_range,
    Literal: lambda args: "one of " + ", ".join(map(repr, args)),
    Union: lambda args: " or ".join(map(_expected, args)),
    types.UnionType: lambda args: " or ".join(map(_expected, args)),
    tuple: _expected_list,
    Mapping: lambda args: f"a mapping, each value {_expected(args[1])}",
}
