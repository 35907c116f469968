"""What a world is built of: solids that stand still, and actors that do not."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple, TypeAlias

import numpy as np

from jaxslam.datasets.synthetic.actors import GroundMotion, Person, Walk
from jaxslam.datasets.synthetic.homogeneous import transform
from jaxslam.datasets.synthetic.primitives import PlacedSolid, Solid, box, pill, scaled_solid, upright
from jaxslam.datasets.synthetic.render import BACKDROP
from jaxslam.datasets.synthetic.seated_people import SeatedBody
from jaxslam.datasets.synthetic.shading import Light
from jaxslam.datasets.synthetic.texture import Material
from jaxslam.geometry.so3 import axis_rotation, matrices, multiply
from jaxslam.worlds import description
from jaxslam.worlds.description import Hand, Kind, Lighting, Part, Thing, World, focal_px
from jaxslam.worlds.finish import Finish, Finishes
from jaxslam.worlds.hand_actor import HandActor
from jaxslam.worlds.motion import RouteWalk
from jaxslam.worlds.roads import RoadLooks, road_solids
from jaxslam.worlds.rooms import room_solids

_GROUND_M = 0.25
"""Half the thickness of the ground."""
_OUT_OF_SIGHT_M = 1e4
_CARRIED_M = (0.36, 0.0, 0.95)
"""Where a carried thing is, in the axes of the person."""
_MOVING_M_PER_S = 1e-3


class Instance(NamedTuple):
    """Something that has a number: a thing or a person.

    Attributes:
        label: Class label.
        movable: Whether it can move, be it at rest or not.
        walk: Its motion on the floor.
        height_m: Height of its origin above the floor.
        turn: Its direction against that of the motion, in radians.
        from_s: Time at which it appears.
        until_s: Time at which it is gone.
        rests: Whether it never moves from its place.
    """

    label: str
    movable: bool
    walk: Walk
    height_m: float
    turn: float
    from_s: float
    until_s: float
    rests: bool = False

    def is_there(self, time_s: np.ndarray) -> np.ndarray:
        """Tell at which of `(t,)` times it is there."""
        return (time_s >= self.from_s) & (time_s < self.until_s)

    def is_moving(self, time_s: np.ndarray) -> np.ndarray:
        """Tell at which of `(t,)` times it is there and moves."""
        return self.is_there(time_s) & (self.walk(time_s).speed_m_per_s > _MOVING_M_PER_S)

    def poses(self, time_s: np.ndarray) -> np.ndarray:
        """Poses of its origin, x ahead, at `(t,)` times: `(t, 7)`, wxyz_xyz."""
        position, heading, _ = self.walk(time_s)
        height = np.full((len(position), 1), self.height_m)
        return np.concatenate([axis_rotation(2, heading + self.turn), position, height], axis=1)


class HandInstance(Instance):
    """A hand before the lens: its origin is that of the camera, and it moves as long as it is there."""

    pose_at: Callable[[np.ndarray], np.ndarray]

    @classmethod
    def of(cls, hand: Hand, pose_at: Callable[[np.ndarray], np.ndarray]) -> "HandInstance":
        """Return the instance of a hand, with poses of the camera."""

        def walk(time_s: np.ndarray) -> GroundMotion:
            return GroundMotion(pose_at(time_s)[:, 4:6], np.zeros(len(time_s)), np.zeros(len(time_s)))

        instance = cls("person", True, walk, 0.0, 0.0, hand.from_s, hand.until_s)
        instance.pose_at = pose_at
        return instance

    def is_moving(self, time_s: np.ndarray) -> np.ndarray:
        """Tell at which of `(t,)` times it is there."""
        return self.is_there(time_s)

    def poses(self, time_s: np.ndarray) -> np.ndarray:
        """Poses of the camera at `(t,)` times: `(t, 7)`, wxyz_xyz."""
        return self.pose_at(time_s)


class Built(NamedTuple):
    """A world as the renderer takes it.

    Attributes:
        static: What stands still all the time; first the backdrop.
        static_numbers: Number of each of them, 0 for what has none.
        actors: What moves, or is there for some time only.
        actor_numbers: Number of each of them.
        instances: Things and people; number `k` is `instances[k - 1]`.
        lights: The light at the beginning, and each later one.
    """

    static: list[PlacedSolid]
    static_numbers: list[int]
    actors: "list[InstanceActor | HandActor]"
    actor_numbers: list[int]
    instances: list[Instance]
    lights: list[Light]


class InstanceActor:
    """An actor of solids, which is out of sight while it is not there."""

    def __init__(
        self, instance: Instance, solids: list[Solid], placed: "_Placed | _WalkingParts", scale: float = 1.0
    ) -> None:
        """Take solids, where they are in the axes of the instance, and a factor of all lengths in `placed`."""
        self.label, self.solids = instance.label, solids
        self._instance, self._placed, self._scale = instance, placed, scale

    def root(self, time_s: np.ndarray) -> np.ndarray:
        """Poses `T_world_actor` at `(t,)` seconds: `(t, 7)`, wxyz_xyz."""
        return self._instance.poses(time_s)

    def parts(self, time_s: np.ndarray) -> np.ndarray:
        """Placements of its solids in its axes: `(t, len(solids), 4, 4)`."""
        parts = np.array(self._placed.parts(time_s))
        parts[..., :3, 3] *= self._scale
        parts[~self._instance.is_there(time_s), :, 2, 3] -= _OUT_OF_SIGHT_M
        return parts

    def scaled(self, instance: Instance, factor: float) -> "InstanceActor":
        """The same actor with all its lengths times a factor, as an instance that is scaled already."""
        return InstanceActor(instance, [scaled_solid(solid, factor) for solid in self.solids], self._placed, factor)


class _Placed(NamedTuple):
    """Solids that do not move against each other: `(k, 4, 4)` placements."""

    T_thing_solid: np.ndarray

    def parts(self, time_s: np.ndarray) -> np.ndarray:
        return np.broadcast_to(self.T_thing_solid, (len(time_s), *self.T_thing_solid.shape))


class _WalkingParts(NamedTuple):
    """The solids of a person, and then those of the thing that the person carries."""

    person: "_Body"
    carried: np.ndarray

    def parts(self, time_s: np.ndarray) -> np.ndarray:
        held = np.broadcast_to(self.carried, (len(time_s), *self.carried.shape))
        return np.concatenate([self.person.parts(time_s), held], axis=1)


_Body: TypeAlias = Person | SeatedBody


class _Standing:
    """A `Walk` of something that stands still."""

    def __init__(self, at_m: Sequence[float], turn_deg: float) -> None:
        self._at, self._heading = np.array(at_m[:2], np.float64), float(np.deg2rad(turn_deg))

    def __call__(self, time_s: np.ndarray) -> GroundMotion:
        n = len(time_s)
        return GroundMotion(np.broadcast_to(self._at, (n, 2)), np.full(n, self._heading), np.zeros(n))


def build(world: World, pose_at: Callable[[np.ndarray], np.ndarray]) -> Built:
    """Build a world that is expanded, with the catalog's looks and kinds in it.

    Args:
        world: The world; every name in it is known.
        pose_at: `(t, 7)` poses `T_world_cam` of its camera, wxyz_xyz, at `(t,)` seconds; its `scale` is in them.
    """
    looks = {name: Finish(look) for name, look in world.looks.items()}
    lights = [_light(lighting) for lighting in (world.lighting, *(change.light for change in world.light_changes))]
    built = Built([_backdrop(world, looks)], [BACKDROP], [], [], [], lights)
    _add_ground(built, world, looks)
    for index, room in enumerate(world.rooms):
        solids = room_solids(room, looks, np.random.default_rng([world.seed, 701, index]))
        built.static.extend(solids)
        built.static_numbers.extend([0] * len(solids))
    for index, thing in enumerate(world.things):
        _add_thing(built, thing, world.kinds[thing.kind], looks, np.random.default_rng([world.seed, 702, index]))
    for index, person in enumerate(world.people):
        carried = None if person.carries is None else world.kinds[person.carries]
        _add_person(built, person, carried, looks, np.random.default_rng([world.seed, 703, index]))
    built = built if world.scale == 1.0 else _scaled(built, world.scale)
    for index, hand in enumerate(world.hands):
        rng = np.random.default_rng([world.seed, 707, index])
        tan = world.camera.height / focal_px(world.camera)
        built.instances.append(HandInstance.of(hand, pose_at))
        built.actors.append(HandActor(hand, pose_at, tan, rng, world.scale))
        built.actor_numbers.append(len(built.instances))
    return built


def _scaled(built: Built, factor: float) -> Built:
    """The same world with all its lengths times a factor."""
    instances = [
        each._replace(walk=partial(_scaled_walk, each.walk, factor), height_m=factor * each.height_m)
        for each in built.instances
    ]
    actors: list[InstanceActor | HandActor] = [
        actor.scaled(instances[number - 1], factor)
        for number, actor in zip(built.actor_numbers, built.actors, strict=True)
        if isinstance(actor, InstanceActor)
    ]
    lights = [
        light._replace(
            lamp_m=np.float32(factor) * light.lamp_m, fading_per_m2=light.fading_per_m2 / np.float32(factor**2)
        )
        for light in built.lights
    ]
    static = [PlacedSolid(_scaled_place(place, factor), scaled_solid(solid, factor)) for place, solid in built.static]
    return built._replace(static=static, actors=actors, instances=instances, lights=lights)


def _scaled_place(T_world_solid: np.ndarray, factor: float) -> np.ndarray:
    return transform(T_world_solid[:3, :3], factor * T_world_solid[:3, 3])


def _scaled_walk(walk: Walk, factor: float, time_s: np.ndarray) -> GroundMotion:
    position, heading, speed = walk(time_s)
    return GroundMotion(factor * position, heading, factor * speed)


def _add_thing(built: Built, thing: Thing, kind: Kind, looks: Finishes, rng: np.random.Generator) -> None:
    solids, places = _parts(kind, looks, rng, thing.scale)
    height_m = float(thing.at_m[2]) if len(thing.at_m) > 2 else 0.0
    route = thing.route
    instance = Instance(
        label=kind.label,
        movable=kind.movable or route is not None,
        walk=_Standing(thing.at_m, thing.turn_deg) if route is None else RouteWalk(route),
        height_m=height_m,
        turn=0.0 if route is None else float(np.deg2rad(thing.turn_deg)),
        from_s=_appears_s(thing),
        until_s=np.inf if thing.until_s is None else thing.until_s,
        rests=route is None,
    )
    built.instances.append(instance)
    number = len(built.instances)
    if route is None and thing.from_s == 0.0 and thing.until_s is None:
        at = upright(thing.at_m[0], thing.at_m[1], height_m, thing.turn_deg)
        built.static.extend(PlacedSolid(at @ place, solid) for place, solid in zip(places, solids, strict=True))
        built.static_numbers.extend([number] * len(solids))
    else:
        built.actors.append(InstanceActor(instance, solids, _Placed(places)))
        built.actor_numbers.append(number)


def _add_person(
    built: Built, person: description.Person, carried: Kind | None, looks: Finishes, rng: np.random.Generator
) -> None:
    walk: Walk = _Standing(person.at_m, person.turn_deg) if person.route is None else RouteWalk(person.route)
    if person.sits:
        body: _Body = SeatedBody(rng)
    else:
        body = Person(walk, float(rng.uniform(0.0, 2.0 * np.pi)), rng)
    until_s = np.inf if person.until_s is None else person.until_s
    instance = Instance("person", True, walk, 0.0, 0.0, _appears_s(person), until_s)
    solids, held = list(body.solids), np.zeros((0, 4, 4))
    if carried is not None:
        more, held = _parts(carried, looks, rng, 1.0)
        solids, held = solids + more, transform(np.eye(3), np.array(_CARRIED_M)) @ held
    built.instances.append(instance)
    built.actors.append(InstanceActor(instance, solids, _WalkingParts(body, held)))
    built.actor_numbers.append(len(built.instances))


def _appears_s(item: Thing | description.Person) -> float:
    """Time at which something appears: what is there from the start is there while the first picture is exposed."""
    return item.from_s if item.from_s > 0.0 else -np.inf


def _parts(kind: Kind, looks: Finishes, rng: np.random.Generator, scale: float) -> tuple[list[Solid], np.ndarray]:
    """The solids of a thing, and their places in its axes, `(k, 4, 4)`."""
    finish = {name: looks[name].material(rng) for name in dict.fromkeys(part.look for part in kind.parts)}
    solids = [_solid(part, finish[part.look], rng, scale) for part in kind.parts]
    places = [
        transform(matrices(_turned(part.turn_deg)), scale * np.array(part.at_m, np.float64)) for part in kind.parts
    ]
    return solids, np.stack(places)


def _solid(part: Part, material: Material, rng: np.random.Generator, scale: float) -> Solid:
    x, y, z = (0.5 * scale * extent for extent in part.size_m)
    if part.shape == "box":
        return box((x, y, z), material, rng)
    if part.shape == "ellipsoid":
        return pill((x, y, z), 0.0, material, rng)
    cap = min(x, y)
    return pill((x, y, cap), 2.0 * (z - cap), material, rng)


def _turned(turn_deg: Sequence[float]) -> np.ndarray:
    x, y, z = (axis_rotation(axis, np.deg2rad(angle)) for axis, angle in enumerate(turn_deg))
    return multiply(z, multiply(y, x))


def _add_ground(built: Built, world: World, looks: Finishes) -> None:
    """Add the ground and the roads on it."""
    solids = []
    rng = np.random.default_rng([world.seed, 706])
    if world.ground is not None:
        low, high = _extent(world)
        half, (x, y, _) = 0.5 * (high - low), 0.5 * (low + high)
        material = looks[world.ground].material(rng)
        slab = box((float(half[0]), float(half[1]), _GROUND_M), material, rng)
        solids.append(PlacedSolid(upright(float(x), float(y), -_GROUND_M), slab))
    for road in world.roads.values():
        materials = RoadLooks(*(looks[name].material(rng) for name in (road.surface, road.paving, road.line)))
        solids += road_solids(road, materials, rng)
    built.static.extend(solids)
    built.static_numbers.extend([0] * len(solids))


def _backdrop(world: World, looks: Finishes) -> PlacedSolid:
    """A box around everything, seen from inside."""
    low, high = _extent(world)
    rng = np.random.default_rng([world.seed, 700])
    half_x, half_y, half_z = 0.5 * (high - low)
    shell = box((float(half_x), float(half_y), float(half_z)), looks[world.backdrop].material(rng), rng)
    return PlacedSolid(upright(*(0.5 * (low + high))), shell)


def _extent(world: World) -> tuple[np.ndarray, np.ndarray]:
    """Lowest and highest coordinates of a world, its backdrop included."""
    points = [np.array([*point[:2], 0.0]) for route in _routes(world) for point in route]
    points += [np.array(point) for point in world.way.points_m or (world.way.at_m,)]
    for room in world.rooms:
        half = 0.5 * np.array(room.size_m)
        points += [np.array([*room.at_m, 0.0]) - half, np.array([*room.at_m, 0.0]) + 2.0 * half]
    points += [np.array([*point, 0.0]) for road in world.roads.values() for point in road.points_m]
    return np.min(points, axis=0) - world.backdrop_m, np.max(points, axis=0) + world.backdrop_m


def _routes(world: World) -> list[Sequence[Sequence[float]]]:
    """Return the ways of things and people, or their one place."""
    placed = [*world.things, *world.people]
    return [(item.at_m,) if item.route is None else item.route.points_m for item in placed]


def _light(lighting: Lighting) -> Light:
    towards = np.array(lighting.from_m, np.float64)
    lamp = lighting.lamp_m
    return Light(
        towards_sun=(towards / np.linalg.norm(towards)).astype(np.float32),
        lamp_m=np.array((0.0, 0.0, 0.0) if lamp is None else lamp, np.float32),
        fading_per_m2=np.float32(0.0 if lamp is None else 1.0 / lighting.reach_m**2),
        brightness=np.float32(lighting.brightness),
        ambient=np.float32(lighting.ambient),
        directed=np.float32(1.0 - lighting.ambient),
    )
