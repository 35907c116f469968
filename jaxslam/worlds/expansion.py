"""The expansion of a world: what its description says in short, as rooms, things, people and points."""

from collections.abc import Mapping
from dataclasses import replace
from typing import TypeVar

import numpy as np

from jaxslam.errors import ConfigError, nearest
from jaxslam.worlds.description import Group, Opening, Person, Place, Road, Room, Route, Side, Thing, Way, World
from jaxslam.worlds.roads import points_along, things_beside

_ARRIVE_WITHIN_S = 3.0
_TURNED: dict[Side, Side] = {"east": "north", "north": "west", "west": "south", "south": "east"}
"""Each wall of a room and where it is after a quarter turn to the left."""

_Placed = TypeVar("_Placed", Thing, Person)
_Points = tuple[tuple[float, ...], ...]


def expanded(world: World) -> World:
    """The same world without places, groups, rows and ways along roads.

    Places must have been loaded into it: see `library.with_places`.

    Raises:
        ConfigError: A way goes along a road that there is not, or beyond it.
    """
    beside = [
        thing
        for index, road in enumerate(world.roads.values())
        for number, row in enumerate(road.rows)
        for thing in things_beside(road, row, np.random.default_rng([world.seed, 704, index, number]))
    ]
    met = [
        person
        for index, group in enumerate(world.groups)
        for person in _people_of(group, np.random.default_rng([world.seed, 705, index]))
    ]
    things = tuple(_on_points(thing, world.roads, f"things[{k}]") for k, thing in enumerate(world.things))
    people = tuple(_on_points(person, world.roads, f"people[{k}]") for k, person in enumerate(world.people))
    return replace(
        world,
        things=(*things, *beside),
        people=(*people, *met),
        groups=(),
        way=_way_on_points(world.way, world),
    )


def _on_points(placed: _Placed, roads: Mapping[str, Road], key: str) -> _Placed:
    """The same thing or person, with the points of its route."""
    route = placed.route
    if route is None or route.along is None:
        return placed
    points = _points(route, roads, key)
    on_points = replace(route, points_m=tuple(map(tuple, points)), along=None, beside_m=0.0, from_m=0.0, until_m=None)
    return replace(placed, route=on_points)


def _way_on_points(way: Way, world: World) -> Way:
    if way.along is None:
        return way
    points = tuple((x, y, way.height_m) for x, y in _points(way, world.roads, "way"))
    return replace(way, points_m=points, along=None, beside_m=0.0, from_m=0.0, until_m=None)


def _points(way: Route | Way, roads: Mapping[str, Road], key: str) -> np.ndarray:
    if way.along is None or way.along not in roads:
        known = nearest(str(way.along), list(roads))
        raise ConfigError(f"{key}: along: expected the name of a road, got '{way.along}'{known}")
    return points_along(roads, way.along, way.beside_m, way.from_m, way.until_m, way.ends)


def _people_of(group: Group, rng: np.random.Generator) -> list[Person]:
    """The people of a group, who stand evenly around the place where they meet."""
    start = rng.uniform(0.0, 2.0 * np.pi)
    walk_s = (group.come_from_m - group.radius_m) / group.speed_m_per_s
    round_s = 2.0 * (walk_s + group.stay_s)
    people = []
    for number in range(group.people):
        angle = start + 2.0 * np.pi * number / group.people
        direction = np.array([np.cos(angle), np.sin(angle)])
        near = np.array(group.at_m) + group.radius_m * direction
        if group.come_from_deg:
            side = np.radians(group.come_from_deg[number % len(group.come_from_deg)])
            direction = np.array([np.cos(side), np.sin(side)])
        far = near + (group.come_from_m - group.radius_m) * direction
        late_s = _ARRIVE_WITHIN_S * rng.uniform() if number else 0.0
        route = Route(
            (tuple(far), tuple(near)),
            speed_m_per_s=group.speed_m_per_s,
            pause_s=group.stay_s,
            delay_s=(group.meet_s + late_s - walk_s - group.stay_s) % round_s,
        )
        people.append(Person(route=route))
    return people


def placed(world: World, place: Place) -> World:
    """The same world somewhere else, turned by quarter turns."""
    quarters = place.turn_deg // 90
    return replace(
        world,
        rooms=tuple(_placed_room(room, place, quarters) for room in world.rooms),
        roads={name: replace(road, points_m=_moved(road.points_m, place)) for name, road in world.roads.items()},
        things=tuple(_placed_thing(thing, place) for thing in world.things),
        people=tuple(_placed_thing(person, place) for person in world.people),
        groups=tuple(_placed_group(group, place) for group in world.groups),
    )


def _moved(points: _Points, place: Place) -> _Points:
    """Points on the floor or above it, turned and moved."""
    quarters = place.turn_deg // 90
    cos, sin = (1, 0, -1, 0)[quarters], (0, 1, 0, -1)[quarters]
    x0, y0 = place.at_m
    return tuple((x0 + cos * x - sin * y, y0 + sin * x + cos * y, *rest) for x, y, *rest in points)


def _placed_room(room: Room, place: Place, quarters: int) -> Room:
    at_m, (length, width, height) = _moved((room.at_m,), place)[0], room.size_m
    size_m = (width, length, height) if quarters % 2 else room.size_m
    openings = room.openings
    for _ in range(quarters):
        openings = tuple(_turned(opening) for opening in openings)
    return replace(room, at_m=at_m, size_m=size_m, openings=openings)


def _turned(opening: Opening) -> Opening:
    """An opening after a quarter turn: +x along the walls north and south becomes +y, and +y along the others -x."""
    sign = 1.0 if opening.wall in {"north", "south"} else -1.0
    return replace(opening, wall=_TURNED[opening.wall], along_m=sign * opening.along_m)


def _placed_group(group: Group, place: Place) -> Group:
    sides = tuple(side + place.turn_deg for side in group.come_from_deg)
    return replace(group, at_m=_moved((group.at_m,), place)[0], come_from_deg=sides)


def _placed_thing(each: _Placed, place: Place) -> _Placed:
    at_m, turn = _moved((each.at_m,), place)[0], each.turn_deg
    if each.route is None:
        return replace(each, at_m=at_m, turn_deg=turn + place.turn_deg)
    return replace(each, at_m=at_m, route=replace(each.route, points_m=_moved(each.route.points_m, place)))
