"""Checks what a kernel is called with, while tracing: shapes, types, one precision, and static options.

`@checked` reads the annotations of a function. A dimension that has a name, as in `Float[Array, "2 n"]`, has the same
size in all arguments; arrays of floating-point numbers all have the same precision. Tuples with names and modules are
looked into. Compiled code knows nothing of it.

Any object with a shape and a dtype is an array, NumPy's too. A Python number stands for an array of no dimensions.
Numbers that JAX types weakly have no precision of their own.
"""

import dataclasses
import difflib
import functools
import inspect
from abc import ABC, abstractmethod
from collections.abc import Callable
from types import UnionType
from typing import Annotated, Any, Literal, NamedTuple, NoReturn, ParamSpec, TypeVar, Union, get_args, get_origin

import jax
import jax.numpy as jnp
import numpy as np
from jaxlie import SE3
from jaxtyping import AbstractArray, Bool, Float, Int, Key, Num, UInt32

P = ParamSpec("P")
R = TypeVar("R")


def checked(function: Callable[P, R]) -> Callable[P, R]:
    """The function with its arguments checked against their annotations.

    `Annotated[SE3, "k"]` is a batch of `k` transforms, a plain `SE3` a single one.

    Raises:
        TypeError: From the function, while tracing, where an argument has another type or precision than expected.
        ValueError: Likewise, where it has another shape, or is an option that does not exist.
    """
    signature = inspect.signature(function)
    specs = {name: _spec(parameter.annotation) for name, parameter in signature.parameters.items()}

    @functools.wraps(function)
    def wrapper(*args: P.args, **kwargs: P.kwargs) -> R:
        scope = _Scope(function.__name__)
        try:
            arguments = signature.bind(*args, **kwargs).arguments
        except TypeError as error:
            raise TypeError(f"{function.__name__}: {error}") from None
        for name, value in arguments.items():
            specs[name].check(value, name, scope)
        return function(*args, **kwargs)

    return wrapper


class _Known(NamedTuple):
    """A size or a precision, and the argument that it comes from."""

    value: Any
    source: str


class _Scope:
    """Sizes and types known from the arguments checked so far."""

    def __init__(self, function: str):
        self.function = function
        self.sizes: dict[str, _Known] = {}
        self.precision: _Known | None = None

    def refuse(self, error: type[Exception], path: str, expected: str, value: Any, more: str = "") -> NoReturn:
        raise error(f"{self.function}: {path}: expected {expected}, got {_told(value)}{more}")


class _Spec(ABC):
    """Requirement of an annotation."""

    @abstractmethod
    def check(self, value: Any, path: str, scope: _Scope) -> None:
        """Raises if the value of the argument at `path` is something else."""


class _Anything(_Spec):
    def check(self, value: Any, path: str, scope: _Scope) -> None:
        pass


_KINDS: dict[Any, tuple[str, Any]] = {
    Float: ("float", jnp.floating),
    Int: ("int", jnp.integer),
    Bool: ("bool", jnp.bool_),
    Num: ("number", jnp.number),
    UInt32: ("uint32", jnp.uint32),
    Key: ("random key", jax.dtypes.prng_key),
}


class _Array(_Spec):
    def __init__(self, annotation: type[AbstractArray]):
        self.kind, self._dtype = _KINDS[annotation.dtype]
        self._dims = tuple(annotation.dim_str.split())

    def takes(self, value: Any) -> bool:
        """Whether this is a number or an array of as many dimensions."""
        if _is_number(value):
            return not self._dims
        return _is_array(value) and (self._variadic() is not None or len(value.shape) == len(self._dims))

    def check(self, value: Any, path: str, scope: _Scope) -> None:
        if _is_number(value) and not self._dims:
            if not self._has_kind(np.asarray(value).dtype) and not (self.kind == "float" and _is_integer(value)):
                scope.refuse(TypeError, path, self.told(scope), value)
            return
        if self.kind == "random key" and _is_old_key(value):
            return
        if not _is_array(value) or not self._has_kind(value.dtype):
            scope.refuse(TypeError, path, self.told(scope), value)
        self._check_precision(value, path, scope)
        self._check_shape(value, path, scope)

    def told(self, scope: _Scope) -> str:
        """Such as `float (2, 60)`, or `float (2, n)` as long as nothing has told what n is."""
        known = [scope.sizes[dim].value if dim in scope.sizes else dim for dim in self._dims]
        return f"{self.kind} {_shape_told(sum((size if isinstance(size, tuple) else (size,) for size in known), ()))}"

    def _has_kind(self, dtype: Any) -> bool:
        return bool(jnp.issubdtype(dtype, self._dtype))

    def _check_precision(self, value: Any, path: str, scope: _Scope) -> None:
        if self.kind != "float" or getattr(value, "weak_type", False):
            return
        dtype = jax.dtypes.canonicalize_dtype(value.dtype)
        if scope.precision is None:
            scope.precision = _Known(dtype, path)
        elif scope.precision.value != dtype:
            expected = self.told(scope).replace("float", str(scope.precision.value), 1)
            scope.refuse(TypeError, path, f"{expected} like {scope.precision.source}", value)

    def _check_shape(self, value: Any, path: str, scope: _Scope) -> None:
        variadic, shape = self._variadic(), tuple(map(int, value.shape))
        spare = len(shape) - len(self._dims)
        if spare != 0 if variadic is None else spare < -1:
            scope.refuse(ValueError, path, self.told(scope), value, self._sources(scope))
        found: dict[str, Any] = {}
        for dim, size in _paired(self._dims, variadic, shape):
            known = found.get(dim, scope.sizes[dim].value if dim in scope.sizes else size)
            if size != (int(dim) if dim.isdigit() else known):
                scope.refuse(ValueError, path, self.told(scope), value, self._sources(scope))
            if not dim.isdigit() and not dim.startswith(("_", "...")):
                found[dim] = size
        for dim, size in found.items():
            scope.sizes.setdefault(dim, _Known(size, path))

    def _variadic(self) -> int | None:
        return next((i for i, dim in enumerate(self._dims) if dim.startswith(("*", "..."))), None)

    def _sources(self, scope: _Scope) -> str:
        known = [
            f"{dim} = {scope.sizes[dim].value} from {scope.sizes[dim].source}"
            for dim in self._dims
            if dim in scope.sizes
        ]
        return f" ({', '.join(dict.fromkeys(known))})" if known else ""


class _Option(_Spec):
    """One of a few static values."""

    def __init__(self, options: tuple):
        self._options = options

    def check(self, value: Any, path: str, scope: _Scope) -> None:
        if isinstance(value, str | int | None) and value in self._options:
            return
        near = difflib.get_close_matches(str(value).lower(), [str(option) for option in self._options], 1)
        hint = f"; did you mean {near[0]!r}?" if near else ""
        error = ValueError if isinstance(value, str) else TypeError
        scope.refuse(error, path, f"one of {', '.join(map(repr, self._options))}", value, hint)


class _Static(_Spec):
    """A Python value of given types, known while tracing."""

    def __init__(self, annotation: type):
        self._annotation = annotation

    def check(self, value: Any, path: str, scope: _Scope) -> None:
        fits = {
            bool: isinstance(value, bool | np.bool_),
            int: _is_integer(value),
            float: _is_number(value)
            or (_is_array(value) and value.shape == () and jnp.issubdtype(value.dtype, jnp.number)),
        }
        if not fits.get(self._annotation, isinstance(value, self._annotation)):
            scope.refuse(TypeError, path, f"a Python {self._annotation.__name__}", value)


class _Transforms(_Spec):
    """One `SE3` or a batch of them."""

    def __init__(self, batch: str = ""):
        self._array = _spec(Float[jax.Array, f"{batch} 7"])

    def check(self, value: Any, path: str, scope: _Scope) -> None:
        if not isinstance(value, SE3):
            scope.refuse(TypeError, path, "SE3", value)
        self._array.check(value.wxyz_xyz, f"{path}.wxyz_xyz", scope)


class _Structure(_Spec):
    """A tuple with names, or a dataclass."""

    def __init__(self, annotation: Any, fields: dict[str, Any]):
        self._annotation = annotation
        self._fields = {name: _spec(field) for name, field in fields.items()}

    def check(self, value: Any, path: str, scope: _Scope) -> None:
        if not isinstance(value, self._annotation):
            scope.refuse(TypeError, path, self._annotation.__name__, value)
        for name, spec in self._fields.items():
            spec.check(getattr(value, name), f"{path}.{name}", scope)


class _Tuple(_Spec):
    def __init__(self, entries: tuple):
        self._any_length = entries[-1] is Ellipsis
        self._entries = [_spec(entry) for entry in entries if entry is not Ellipsis]

    def check(self, value: Any, path: str, scope: _Scope) -> None:
        if not isinstance(value, tuple) or (not self._any_length and len(value) != len(self._entries)):
            length = "" if self._any_length else f" of {len(self._entries)}"
            scope.refuse(TypeError, path, f"a tuple{length}", value)
        specs = self._entries * len(value) if self._any_length else self._entries
        for index, (spec, entry) in enumerate(zip(specs, value, strict=True)):
            spec.check(entry, f"{path}[{index}]", scope)


class _OneOf(_Spec):
    """A union: `None`, arrays of different dimensions, numbers, or one other thing."""

    def __init__(self, members: tuple):
        self._optional = type(None) in members
        specs = [_spec(member) for member in members if member is not type(None)]
        self._arrays = [spec for spec in specs if isinstance(spec, _Array)]
        self._others = [spec for spec in specs if not isinstance(spec, _Array)]

    def check(self, value: Any, path: str, scope: _Scope) -> None:
        if value is None and self._optional:
            return
        if not self._arrays:
            self._others[0].check(value, path, scope)  # no annotation has two of them
        elif fitting := next((spec for spec in self._arrays if spec.takes(value)), None):
            fitting.check(value, path, scope)
        elif len(self._arrays) == 1:
            self._arrays[0].check(value, path, scope)
        else:
            expected = " or ".join(spec.told(scope) for spec in self._arrays)
            scope.refuse(ValueError if _is_array(value) else TypeError, path, expected, value)


def _spec(annotation: Any) -> _Spec:
    """Read the requirement of an annotation; anything is allowed where the annotation is of no known kind."""
    origin, arguments = get_origin(annotation), get_args(annotation)
    if origin in (Union, UnionType):
        members = [_spec(argument) for argument in arguments if argument is not type(None)]
        return _Anything() if any(isinstance(member, _Anything) for member in members) else _OneOf(arguments)
    if origin is Literal:
        return _Option(arguments)
    if origin is tuple:
        return _Tuple(arguments)
    if origin is Annotated and arguments[0] is SE3:
        return _Transforms(arguments[1])
    if not isinstance(annotation, type):
        return _Anything()
    return _spec_of_class(annotation)


@functools.cache
def _spec_of_class(annotation: Any) -> _Spec:
    if annotation is SE3:
        return _Transforms()
    if issubclass(annotation, AbstractArray):
        return _Array(annotation)
    if issubclass(annotation, tuple) and hasattr(annotation, "_fields"):
        return _Structure(annotation, inspect.get_annotations(annotation))
    if dataclasses.is_dataclass(annotation):
        return _Structure(annotation, {field.name: field.type for field in dataclasses.fields(annotation)})
    return _Static(annotation) if annotation in (bool, int, float, str) else _Anything()


def _paired(dims: tuple[str, ...], variadic: int | None, shape: tuple[int, ...]) -> list[tuple[str, Any]]:
    """Each dimension with its size, and the one that stands for any number of them with all of theirs."""
    if variadic is None:
        return list(zip(dims, shape, strict=True))
    after = len(dims) - variadic - 1
    rest = shape[variadic : len(shape) - after]
    sizes = [*shape[:variadic], rest, *shape[len(shape) - after :]]
    return list(zip(dims, sizes, strict=True))


def _shape_told(shape: tuple) -> str:
    return f"({', '.join(map(str, shape))}{',' if len(shape) == 1 else ''})"


def _is_array(value: Any) -> bool:
    return hasattr(value, "shape") and hasattr(value, "dtype")


def _is_number(value: Any) -> bool:
    """A number of Python or NumPy, not an array."""
    return isinstance(value, bool | int | float | np.generic)


def _is_integer(value: Any) -> bool:
    return isinstance(value, int | np.integer) and not isinstance(value, bool)


def _is_old_key(value: Any) -> bool:
    """A random key as plain numbers, from `jax.random.PRNGKey`."""
    return _is_array(value) and value.dtype == jnp.uint32 and len(value.shape) == 1


def _told(value: Any) -> str:
    """Such as `float32 (60, 2)`."""
    if _is_array(value) and not isinstance(value, np.generic):
        return f"{value.dtype} {_shape_told(value.shape)}"
    return repr(value) if isinstance(value, bool | int | float | str | None) else type(value).__name__
