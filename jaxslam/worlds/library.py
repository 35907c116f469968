"""The worlds that come with jaxslam, and those in files of the user."""

import functools
from collections.abc import Collection, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

from jaxslam.config.loading import configs_dir
from jaxslam.config.validation import from_mapping
from jaxslam.errors import ConfigError, nearest
from jaxslam.io.yaml_files import read_mapping
from jaxslam.worlds.data_paths import beside
from jaxslam.worlds.description import Catalog, World
from jaxslam.worlds.expansion import placed

_Named = TypeVar("_Named")


def worlds() -> list[str]:
    """List the names of the worlds that come with jaxslam."""
    return sorted(path.stem for path in _folder().glob("*.yaml"))


def load_world(name: str | Path) -> World:
    """Load a world.

    Args:
        name: A name from `worlds()`, or a YAML file.

    Raises:
        ConfigError: If there is none of that name, a key or value in the file is wrong, or it names a file in
            `$JAXSLAM_DATA` and that is not set.
    """
    path = Path(name)
    if not _is_file(str(name)):
        path = _folder() / f"{name}.yaml"
        if str(name) not in worlds():
            raise ConfigError(
                f"world: expected the name of a world or a YAML file, got '{name}'{nearest(str(name), worlds())}"
            )
    world = from_mapping(World, read_mapping(path, ConfigError), str(path))
    with_catalog(world, str(path))
    return _with_paths(world, path.parent)


def _with_paths(world: World, folder: Path) -> World:
    """The world with paths of its files that are right wherever they are read from."""

    def found(given: str | None) -> str | None:
        return None if given is None else beside(given, folder)

    way, imu, people = replace(world.way, file=found(world.way.file)), world.imu, world.real_people
    if imu is not None:
        imu = replace(imu, sheet=found(imu.sheet), file=found(imu.file))
    if people is not None:
        people = replace(people, recording=beside(people.recording, folder), network=beside(people.network, folder))
    places = tuple(
        replace(each, world=beside(each.world, folder)) if _is_file(each.world) else each for each in world.places
    )
    return replace(world, way=way, imu=imu, real_people=people, places=places)


def _is_file(name: str) -> bool:
    return Path(name).suffix in {".yaml", ".yml"}


def with_places(world: World, within: tuple[str, ...] = ()) -> World:
    """The world with all that other worlds in it hold: their rooms, roads, things, people, kinds and looks.

    Args:
        world: The world.
        within: Names of the worlds that this one is part of.

    Raises:
        ConfigError: If there is no such world, it holds itself, or two of them have roads, kinds or looks of the same
            name that differ.
    """
    whole = world
    for each in world.places:
        if each.world in within:
            raise ConfigError(f"places: world: expected one that is not part of itself, got '{each.world}'")
        part = placed(with_places(load_world(each.world), (*within, each.world)), each)
        whole = replace(
            whole,
            rooms=(*whole.rooms, *part.rooms),
            things=(*whole.things, *part.things),
            people=(*whole.people, *part.people),
            groups=(*whole.groups, *part.groups),
            roads=_joined("roads", whole.roads, part.roads, each.world),
            kinds=_joined("kinds", whole.kinds, part.kinds, each.world),
            looks=_joined("looks", whole.looks, part.looks, each.world),
        )
    return replace(whole, places=())


def _joined(field: str, ours: Mapping[str, _Named], theirs: Mapping[str, _Named], world: str) -> dict[str, _Named]:
    """Entries by name of a world and of one that is part of it."""
    unlike = [name for name, entry in theirs.items() if ours.get(name, entry) != entry]
    if unlike:
        raise ConfigError(
            f"places: {world}: {field}: expected other names or the same entries, got another {unlike[0]}"
        )
    return {**ours, **theirs}


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
    if full.ground is not None:
        _check_name(full.ground, full.looks, f"{place}: ground")
    for name, road in full.roads.items():
        for field in ("surface", "paving", "line"):
            _check_name(getattr(road, field), full.looks, f"{place}: roads: {name}: {field}")
        for index, row in enumerate(road.rows):
            for kind in row.kinds:
                _check_name(kind, full.kinds, f"{place}: roads: {name}: rows[{index}]: kinds")
    for index, thing in enumerate(full.things):
        _check_name(thing.kind, full.kinds, f"{place}: things[{index}]: kind")
    for index, person in enumerate(full.people):
        if person.carries is not None:
            _check_name(person.carries, full.kinds, f"{place}: people[{index}]: carries")


def _check_name(name: str, known: Collection[str], key: str) -> None:
    if name not in known:
        raise ConfigError(f"{key}: expected a known name, got '{name}'{nearest(name, list(known))}")
