"""Reading YAML: plain safe YAML, strict about duplicate keys, tolerant of OpenCV's dialect."""

import re
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

import yaml

from jaxslam.errors import JaxSlamError, nearest

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

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        """A mapping, refused when a key stands twice (PyYAML would keep the last)."""
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
    """What `text` holds: a scalar, list or mapping, or `None` if it is empty.

    Raises:
        JaxSlamError: Of class `error`, naming `origin` and the line, if it is no YAML or a key stands twice.
    """
    try:
        return yaml.load(_OPENCV_HEADER.sub("", text), Loader=_Loader)
    except yaml.MarkedYAMLError as problem:
        line = f":{problem.problem_mark.line + 1}" if problem.problem_mark else ""
        raise error(f"{origin}{line}: not readable as YAML: {problem.problem}") from None
    except (yaml.YAMLError, ValueError) as problem:
        raise error(f"{origin}: not readable as YAML: {' '.join(str(problem).split())}") from None


def read_mapping(path: Path, error: type[JaxSlamError]) -> dict[str, Any]:
    """The mapping that a YAML file holds; empty if the file holds nothing but comments.

    Raises:
        JaxSlamError: Of class `error`, naming the file, if it is missing, no text, no YAML or no mapping.
    """
    try:
        text = path.read_text(encoding="utf-8-sig")
    except OSError as problem:
        raise error(f"{path}: cannot be read: {problem.strerror}") from None
    except UnicodeDecodeError:
        raise error(f"{path}: expected a text file in UTF-8, got something else") from None
    content = parse_yaml(text, str(path), error)
    if content is None:
        return {}
    if not isinstance(content, dict):
        raise error(f"{path}: expected `key: value` lines, got {type(content).__name__}")
    return {str(key): value for key, value in content.items()}


def check_keys(
    content: Mapping[str, Any], known: Collection[str], needed: Collection[str], place: str, error: type[JaxSlamError]
) -> None:
    """Refuse a mapping with a key that is not known, or without one that is needed.

    Raises:
        JaxSlamError: Of class `error`, naming `place` and the keys.
    """
    for key in content:
        if key not in known:
            raise error(f"{place}: unknown key '{key}'{nearest(key, known)}")
    missing = [key for key in needed if key not in content]
    if missing:
        raise error(f"{place}: missing {', '.join(map(repr, missing))}")
