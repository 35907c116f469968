"""Load settings in layers: overrides (the command line) over a file, over a preset, over the defaults.

The dataclasses of `schema.py` hold the only defaults; presets, files and overrides hold only differences from them.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import yaml

from jaxslam.config.schema import Config
from jaxslam.config.validation import ValidatedConfig, checked_value, field_hints, section_of
from jaxslam.errors import ConfigError, nearest, one_line
from jaxslam.io.yaml_files import parse_yaml, read_mapping

_Section = TypeVar("_Section")

_RENAMED = {
    "dynamics.even_votes": "dynamics.balance_regions",
    "dynamics.newcomers": "dynamics.new_surfaces",
    "track.hold_to_map": "track.match_map",
    "track.keyframe_choice": "track.keyframe_policy",
    "track.keyframe_least_s": "track.keyframe_min_s",
    "track.num_recalled": "track.num_reloaded",
    "track.refill_below": "track.detect_below",
}
"""Earlier names of settings, each with its present name."""


def load_config(preset: str = "default", file: str | Path | None = None, overrides: Sequence[str] = ()) -> Config:
    """Load the settings of a run.

    Args:
        preset: A name from `presets()`.
        file: A YAML file of differences. It beats the preset, and may itself `inherit:` another preset.
        overrides: `key=value` texts with dotted keys, such as `track.num_points=400`. They beat the file.

    Raises:
        ConfigError: If a preset or file is missing, a key is unknown (at any depth), or a value has the wrong
            type or is out of range. The message names the layer, the key, what was expected and what was given.
    """
    layers = _preset_layers(preset)
    if file is not None:
        layers += _file_layers(Path(file))
    layers.append(("override", _parsed_overrides(overrides)))
    config = Config()
    for origin, changes in layers:
        try:
            config = updated(config, changes)
        except ConfigError as error:
            raise ConfigError(f"{origin}: {error}") from None
    return config


def to_yaml(config: ValidatedConfig) -> str:
    """Convert all settings to YAML; `load_config(file=...)` reads it back to an equal `Config`."""
    return yaml.safe_dump(_plain(dataclasses.asdict(config)), sort_keys=False)


def updated(section: _Section, changes: Mapping[str, Any], path: str = "") -> _Section:
    """Copy a section with changes applied; nested mappings change nested sections.

    Args:
        section: An instance of a frozen dataclass derived from `ValidatedConfig`.
        changes: New values by field name.
        path: Dotted name of the section, for messages.

    Raises:
        ConfigError: If a key is unknown, or a value has the wrong type or is out of range.
    """
    hints = field_hints(type(section))
    values: dict[str, Any] = {}
    for key, value in changes.items():
        name = f"{path}.{key}" if path else str(key)
        if name in _RENAMED:
            raise ConfigError(f"{name}: renamed, use {_RENAMED[name]}")
        if key not in hints:
            raise ConfigError(f"{one_line(name, 80)}: unknown key{nearest(str(key), hints)}")
        values[key] = _updated_value(hints[key], getattr(section, key), value, name)
    return dataclasses.replace(section, **values)  # type: ignore[type-var]


def presets() -> list[str]:
    """List the names of the presets that are installed with jaxslam."""
    return sorted(path.stem for path in (configs_dir() / "presets").glob("*.yaml"))


def configs_dir() -> Path:
    """Find the folder of cameras, presets and benchmarks: in an installed package, or beside it in a checkout.

    Raises:
        ConfigError: If it is in neither place.
    """
    package = Path(__file__).resolve().parents[1]
    for folder in (package / "_configs", package.parent / "configs"):
        if folder.is_dir():
            return folder
    raise ConfigError(f"configs: expected the folder _configs in {package} or configs beside it, got neither")


def _updated_value(hint: Any, current: Any, value: object, name: str) -> Any:
    section = section_of(hint)
    if section is None:
        return checked_value(hint, value, name)
    if isinstance(value, Mapping):
        return updated(section() if current is None else current, value, name)
    if value is None and current is not None:  # a heading with every line under it commented out
        return current
    return checked_value(hint, value, name)


def _preset_layers(name: str, heirs: tuple[str, ...] = ()) -> list[tuple[str, dict[str, Any]]]:
    """The layers of a preset, those it inherits first. `heirs` are the presets that inherit it, for messages."""
    if name in heirs:
        raise ConfigError(f"preset {heirs[0]}: inherits itself: {' -> '.join((*heirs, name))}")
    if name not in presets():
        by = f"preset {heirs[-1]}: inherit: " if heirs else "preset: "
        raise ConfigError(f"{by}expected a known preset, got '{name:.24}'{nearest(name, presets())}")
    return _file_layers(configs_dir() / "presets" / f"{name}.yaml", (*heirs, name))


def _file_layers(path: Path, heirs: tuple[str, ...] = ()) -> list[tuple[str, dict[str, Any]]]:
    changes = read_mapping(path, ConfigError)
    parent = changes.pop("inherit", None)
    if parent is None:
        return [(str(path), changes)]
    if not isinstance(parent, str):
        raise ConfigError(f"{path}: inherit: expected the name of a preset, got {parent!r}")
    return [*_preset_layers(parent, heirs), (str(path), changes)]


def _parsed_overrides(overrides: Sequence[str]) -> dict[str, Any]:
    """Nested changes from `key=value` texts."""
    changes: dict[str, Any] = {}
    for override in overrides:
        key, equals, text = override.partition("=")
        if not equals or not key.strip():
            raise ConfigError(f"override: expected key=value such as track.num_points=400, got '{override}'")
        value = parse_yaml(text, f"override {key}", ConfigError)
        *sections, last = key.strip().split(".")
        place = changes
        for section in sections:
            inner = place.setdefault(section, {})
            if not isinstance(inner, dict):
                raise ConfigError(f"override: '{override}' needs a section, but '{section}' is set to {inner!r}")
            place = inner
        place[last] = value
    return changes


def _plain(value: object) -> object:
    """The same settings with lists in place of tuples, which safe YAML does not have."""
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    return [_plain(item) for item in value] if isinstance(value, tuple) else value
