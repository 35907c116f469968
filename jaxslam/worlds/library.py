"""The worlds that come with jaxslam, and those in files of the user."""

import functools
from collections.abc import Collection
from dataclasses import replace
from pathlib import Path

from jaxslam.config.loading import configs_dir
from jaxslam.config.validation import from_mapping
from jaxslam.errors import ConfigError, nearest
from jaxslam.io.yaml_files import read_mapping
from jaxslam.worlds.data_paths import beside
from jaxslam.worlds.description import Catalog, World


def worlds() -> list[str]:
    """List the names of the worlds that come with jaxslam."""
    return sorted(path.stem for path in _folder().glob("*.yaml"))


def load_world(name: str | Path) -> World:
    """Load a world.

    Args:
        name: A name from `worlds()`, or a YAML file.

    Raises:
        ConfigError: If there is none of that name, or a key or value in the file is wrong.
    """
    path = Path(name)
    if path.suffix not in {".yaml", ".yml"}:
        path = _folder() / f"{name}.yaml"
        if str(name) not in worlds():
            raise ConfigError(
                f"world: expected the name of a world or a YAML file, got '{name}'{nearest(str(name), worlds())}"
            )
    world = from_mapping(World, read_mapping(path, ConfigError), str(path))
    with_catalog(world, str(path))
    return _with_paths(world, path.parent)


def with_catalog(world: World, place: str = "world") -> World:
    """The world with all looks and kinds of the catalog; its own ones come first.

    Args:
        world: The world.
        place: Name of the world or its file, for messages.

    Raises:
        ConfigError: The world names a look or kind that is neither its own nor in the catalog.
    """
    shared = catalog()
    full = replace(world, looks={**shared.looks, **world.looks}, kinds={**shared.kinds, **world.kinds})
    _check_names(full, place)
    return full


@functools.cache
def catalog() -> Catalog:
    """Return the looks and kinds that any world can use."""
    path = configs_dir() / "world_catalog.yaml"
    return from_mapping(Catalog, read_mapping(path, ConfigError), str(path))


def _with_paths(world: World, folder: Path) -> World:
    """The world with files that lie beside the description, wherever that is read from."""
    way, people = world.way, world.real_people
    if way.file is not None:
        world = replace(world, way=replace(way, file=beside(way.file, folder)))
    if people is not None:
        recording, network = beside(people.recording, folder), beside(people.network, folder)
        world = replace(world, real_people=replace(people, recording=recording, network=network))
    return world


def _folder() -> Path:
    return configs_dir() / "worlds"


def _check_names(full: World, place: str) -> None:
    """Refuse names of looks and kinds that are not known."""
    for name, kind in full.kinds.items():
        for index, part in enumerate(kind.parts):
            _check_name(part.look, full.looks, f"{place}: kinds: {name}: parts[{index}]: look")
    for index, room in enumerate(full.rooms):
        for field in ("floor", "walls", "ceiling"):
            _check_name(getattr(room, field), full.looks, f"{place}: rooms[{index}]: {field}")
    _check_name(full.backdrop, full.looks, f"{place}: backdrop")
    for index, thing in enumerate(full.things):
        _check_name(thing.kind, full.kinds, f"{place}: things[{index}]: kind")
    for index, person in enumerate(full.people):
        if person.carries is not None:
            _check_name(person.carries, full.kinds, f"{place}: people[{index}]: carries")


def _check_name(name: str, known: Collection[str], key: str) -> None:
    if name not in known:
        raise ConfigError(f"{key}: expected a known name, got '{name}'{nearest(name, list(known))}")
