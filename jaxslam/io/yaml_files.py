"""Read safe YAML; duplicate keys are refused, and OpenCV's dialect is accepted."""

import re
import reprlib
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

import yaml

from jaxslam.errors import JaxSlamError, nearest, one_line

_MAX_CHARACTERS = 1 << 17
"""Size limit of a file. PyYAML takes longer than a second for more; files written by hand have a tenth of it."""
_OPENCV_HEADER = re.compile(r"\A%YAML:[^\n]*")
_FLOAT_TAG, _BOOL_TAG = "tag:yaml.org,2002:float", "tag:yaml.org,2002:bool"
_NUMBER = r"[-+]?(?:\d+\.\d*|\.\d+|\d+(?=[eE]))(?:[eE][-+]?\d+)?"
_FLOAT = re.compile(rf"(?:{_NUMBER}|[-+]?\.(?:inf|Inf)|\.(?:nan|NaN))\Z")
_BOOL = re.compile(r"(?:true|True|TRUE|false|False|FALSE)\Z")


class _Loader(yaml.SafeLoader):
    """Safe YAML with the scalars of YAML 1.2: `1e-3` is a number; `on`, `off`, `yes` and `no` are text."""

    yaml_implicit_resolvers = {  # noqa: RUF012 (PyYAML's own registry)
        first: [resolver for resolver in resolvers if resolver[0] not in (_FLOAT_TAG, _BOOL_TAG)]
        for first, resolvers in yaml.SafeLoader.yaml_implicit_resolvers.items()
    }

    def construct_object(self, node: yaml.Node, deep: bool = False) -> Any:
        """Construct a value; errors about a tag that does not fit, such as `!!bool z`, get the number of the line."""
        try:
            value = super().construct_object(node, deep)
            if isinstance(value, int):
                float(value)  # 400 digits are no number that anything here could use
        except (ValueError, LookupError, TypeError, AttributeError, OverflowError):
            kind = node.tag.rpartition(":")[2]
            problem = f"expected a value of type {kind}, got {node.value!r:.40}"
            raise yaml.constructor.ConstructorError(None, None, problem, node.start_mark) from None
        return value

    def construct_mapping(self, node: yaml.Node, deep: bool = False) -> dict[Any, Any]:
        """Construct a mapping; duplicate keys are refused (PyYAML would keep the last)."""
        if not isinstance(node, yaml.MappingNode):
            problem = f"expected `key: value` lines, got {node.value!r:.40}"
            raise yaml.constructor.ConstructorError(None, None, problem, node.start_mark)
        keys = [key for key, _ in node.value if isinstance(key, yaml.ScalarNode)]
        names = [key.value for key in keys]
        for position, key in enumerate(keys):
            if key.value in names[:position]:
                problem = f"'{key.value}' stands twice"
                raise yaml.constructor.ConstructorError(None, None, problem, key.start_mark)
        return super().construct_mapping(node, deep)

    def construct_opencv_matrix(self, node: yaml.MappingNode) -> dict[Any, Any]:
        return self.construct_mapping(node, deep=True)


_Loader.add_implicit_resolver(_FLOAT_TAG, _FLOAT, list("-+.0123456789"))
_Loader.add_implicit_resolver(_BOOL_TAG, _BOOL, list("tTfF"))
_Loader.add_constructor("tag:yaml.org,2002:opencv-matrix", _Loader.construct_opencv_matrix)


def parse_yaml(text: str, origin: str, error: type[JaxSlamError]) -> Any:
    """Parse YAML into a scalar, list or mapping, or `None` if the text is empty.

    Args:
        text: The YAML.
        origin: Name of the source in messages, such as the path of a file.
        error: Class of the error to raise.

    Raises:
        JaxSlamError: An error of class `error`, naming `origin` and the line, if the text is no YAML, has a
            duplicate key, or is too long or nested too deep.
    """
    if len(text) > _MAX_CHARACTERS:
        raise error(f"{origin}: expected at most {_MAX_CHARACTERS} characters of YAML, got {len(text)}")
    try:
        content = yaml.load(_OPENCV_HEADER.sub("", text), Loader=_Loader)
        num_values = _num_values(content, {})
    except yaml.MarkedYAMLError as problem:
        line = f":{problem.problem_mark.line + 1}" if problem.problem_mark else ""
        raise error(f"{origin}{line}: not readable as YAML: {one_line(problem.problem)}") from None
    except (yaml.YAMLError, ValueError) as problem:
        raise error(f"{origin}: not readable as YAML: {one_line(problem)}") from None
    except RecursionError:
        raise error(f"{origin}: not readable as YAML: nested too deep, or holds itself") from None
    if num_values > _MAX_CHARACTERS:
        raise error(f"{origin}: expected at most {_MAX_CHARACTERS} values, got {num_values:.3g} by aliases")
    return content


def _num_values(content: Any, known: dict[int, int]) -> int:
    """Count the values, with every alias counted as often as it is used.

    Args:
        content: Scalar, list or mapping.
        known: Counts of the lists and mappings counted so far, by their `id`.

    Raises:
        RecursionError: If a list or mapping holds itself.
    """
    if not isinstance(content, dict | list | tuple | set):
        return 1
    if id(content) not in known:
        parts = (part for pair in content.items() for part in pair) if isinstance(content, dict) else content
        known[id(content)] = 1 + sum(_num_values(part, known) for part in parts)
    return known[id(content)]


def read_yaml(path: Path, error: type[JaxSlamError]) -> Any:
    """Read a YAML file as a scalar, list or mapping, or `None` if the file is empty.

    Raises:
        JaxSlamError: An error of class `error`, naming the file, if the file is missing, no text or no YAML.
    """
    try:
        text = path.read_text(encoding="utf-8-sig")
    except OSError as problem:
        raise error(f"{path}: cannot be read: {problem.strerror}") from None
    except UnicodeDecodeError:
        raise error(f"{path}: expected a text file in UTF-8, got something else") from None
    return parse_yaml(text, str(path), error)


def read_mapping(path: Path, error: type[JaxSlamError]) -> dict[str, Any]:
    """Read the mapping in a YAML file; it is empty if the file holds only comments.

    Raises:
        JaxSlamError: An error of class `error`, naming the file, if the file is missing, or is no text, no YAML or no
            mapping.
    """
    content = read_yaml(path, error)
    return {} if content is None else checked_mapping(content, str(path), error)


def checked_mapping(content: object, place: str, error: type[JaxSlamError]) -> dict[str, Any]:
    """Return a mapping with its keys as text.

    Args:
        content: Content of the file.
        place: File and section of the content, as errors name it.
        error: Class of the error to raise.

    Raises:
        JaxSlamError: An error of class `error`, naming `place`, if the content is no mapping.
    """
    if not isinstance(content, Mapping):
        raise error(f"{place}: expected `key: value` lines, got {reprlib.repr(content)}")
    return {str(key): value for key, value in content.items()}


def check_keys(
    content: Mapping[str, Any], known: Collection[str], needed: Collection[str], place: str, error: type[JaxSlamError]
) -> None:
    """Refuse a mapping that has an unknown key, or lacks a required one.

    Args:
        content: Mapping to check.
        known: Keys that are allowed.
        needed: Keys that are required.
        place: File and section of the mapping, as errors name it.
        error: Class of the error to raise.

    Raises:
        JaxSlamError: An error of class `error`, naming `place` and the keys.
    """
    for key in content:
        if key not in known:
            raise error(f"{place}: unknown key '{one_line(key, 40)}'{nearest(str(key), known)}")
    missing = [key for key in needed if key not in content]
    if missing:
        raise error(f"{place}: missing {', '.join(map(repr, missing))}")
