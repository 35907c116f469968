"""The description of a world: dataclasses, and YAML files of the same.

Axes of a world: x and y on the floor, z up, in meters. Angles are in degrees, counterclockwise seen from above; 0 faces
along x. Axes of a thing: x ahead, y to its left, z up, origin on the floor under its middle.
"""

import itertools
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Literal, TypeAlias

from jaxslam.config.validation import Positive, Range, Share, ValidatedConfig
from jaxslam.datasets.synthetic.sensor_noise import SensorConfig
from jaxslam.errors import ConfigError

Color: TypeAlias = tuple[Annotated[float, Share], Annotated[float, Share], Annotated[float, Share]]
Length: TypeAlias = Annotated[float, Positive]
Plan: TypeAlias = tuple[float, float]
Point: TypeAlias = tuple[float, float, float]
Pose: TypeAlias = tuple[float, float, float, float, float, float, float]

Side: TypeAlias = Literal["north", "south", "east", "west"]
"""Walls of a room: north is towards +y, east towards +x."""

_UNIT_TOLERANCE = 1e-3
"""Difference from 1 of the length of a quaternion that is written with few digits."""


@dataclass(frozen=True)
class Look(ValidatedConfig):
    """Appearance of a surface: noise between two colors, bricks or planks, and scattered patches.

    Attributes:
        color: RGB from 0 to 1 where the noise is low.
        second: RGB where the noise is high.
        dark: RGB of one half of the bricks and patches.
        bright: RGB of the other half.
        noise_per_m: Cells a meter of the coarsest noise.
        stretch: Factor by which the noise is longer upward.
        noise: Strength of the noise.
        cell_m: Width and height of bricks, tiles or planks.
        joint_m: Width of the joints between them; 0 for none.
        cell_contrast: Contrast between bricks.
        patch_m: Cell of the largest patches; smaller ones follow.
        patch_density: Probability that a cell holds a patch.
        patch_contrast: Contrast of a patch to what it covers.
        printed: Whether each thing has a `dark` and a `bright` of its own, as books and posters have.
    """

    color: Color
    second: Color
    dark: Color = (0.15, 0.13, 0.12)
    bright: Color = (0.92, 0.90, 0.85)
    noise_per_m: Length = 2.0
    stretch: Length = 1.0
    noise: Annotated[float, Share] = 0.5
    cell_m: tuple[Length, Length] = (1.0, 1.0)
    joint_m: Annotated[float, Range(at_least=0)] = 0.0
    cell_contrast: Annotated[float, Share] = 0.0
    patch_m: Length = 0.5
    patch_density: Annotated[float, Share] = 0.0
    patch_contrast: Annotated[float, Share] = 0.8
    printed: bool = False


@dataclass(frozen=True)
class Part(ValidatedConfig):
    """One solid of a thing.

    Attributes:
        size_m: Extent along x, y and z in meters, before it is turned.
        at_m: Its center in the axes of the thing.
        look: Name of a look.
        shape: A box, a capsule along z (a cylinder with round ends, which `size_m` includes) or an ellipsoid.
        turn_deg: Rotation about x, then y, then z, in degrees.
    """

    size_m: tuple[Length, Length, Length]
    at_m: Point
    look: str
    shape: Literal["box", "capsule", "ellipsoid"] = "box"
    turn_deg: Point = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.shape == "capsule" and self.size_m[2] < max(self.size_m[:2]):
            raise ConfigError(f"Part.size_m: expected a capsule at least as long as wide, got {self.size_m}")


@dataclass(frozen=True)
class Kind(ValidatedConfig):
    """A kind of thing.

    Attributes:
        label: Class label, one of COCO's names where there is one.
        parts: Its solids.
        movable: Whether such things can move.
    """

    label: str
    parts: tuple[Part, ...]
    movable: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.parts:
            raise ConfigError("Kind.parts: expected at least one part, got none")


@dataclass(frozen=True)
class Route(ValidatedConfig):
    """A way on the floor, at a constant speed but at corners and ends, which are rounded.

    Attributes:
        points_m: Points `(x, y)` on the floor; at least two.
        speed_m_per_s: Speed along the way.
        ends: At the last point: `back` to the first one and on, round in a `loop` to the first one and on, or `stop`.
        pause_s: Time of rest at the first and the last point; with `loop`, at the first one.
        delay_s: Time at the first point before it begins; what has no `stop` is so far behind on its way instead.
        backward: Whether it goes backward, as a car that reverses.
    """

    points_m: tuple[Plan, ...]
    speed_m_per_s: Annotated[float, Range(above=0, at_most=100)] = 1.0
    ends: Literal["back", "loop", "stop"] = "back"
    pause_s: Annotated[float, Range(at_least=0)] = 0.0
    delay_s: Annotated[float, Range(at_least=0)] = 0.0
    backward: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        _check_points("Route.points_m", self.points_m)


@dataclass(frozen=True)
class Thing(ValidatedConfig):
    """A thing in its place, or on its way.

    Attributes:
        kind: Name of a kind.
        at_m: `(x, y)`, or `(x, y, z)` for one that stands on something; with a `route`, its height counts.
        turn_deg: Direction that it faces; with a `route`, against the direction of the way.
        scale: Factor of its size.
        route: Its way; `None` for a thing that stands still.
        from_s: Time at which it appears.
        until_s: Time at which it is gone; `None` for never.
    """

    kind: str
    at_m: Plan | Point = (0.0, 0.0)
    turn_deg: float = 0.0
    scale: Length = 1.0
    route: Route | None = None
    from_s: Annotated[float, Range(at_least=0)] = 0.0
    until_s: Annotated[float, Positive] | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        _check_span("Thing", self.from_s, self.until_s)


@dataclass(frozen=True)
class Person(ValidatedConfig):
    """A person who walks a route, or stands.

    Attributes:
        at_m: `(x, y)` of one who stands.
        turn_deg: Direction that one who stands faces.
        route: The way of one who walks; `None` for one who stands.
        carries: Name of the kind of thing that the person carries before the chest; `None` for nothing.
        from_s: Time at which the person appears.
        until_s: Time at which the person is gone; `None` for never.
    """

    at_m: Plan = (0.0, 0.0)
    turn_deg: float = 0.0
    route: Route | None = None
    carries: str | None = None
    from_s: Annotated[float, Range(at_least=0)] = 0.0
    until_s: Annotated[float, Positive] | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        _check_span("Person", self.from_s, self.until_s)


@dataclass(frozen=True)
class Opening(ValidatedConfig):
    """A door or window in a wall of a room.

    Attributes:
        wall: The wall.
        along_m: Middle of the opening, in meters from the middle of the wall: towards +x in the walls north and south,
            towards +y in the others.
        width_m: Width.
        bottom_m: Height of its lower edge above the floor.
        top_m: Height of its upper edge above the floor.
    """

    wall: Side
    along_m: float = 0.0
    width_m: Length = 0.9
    bottom_m: Annotated[float, Range(at_least=0)] = 0.0
    top_m: Length = 2.05


@dataclass(frozen=True)
class Room(ValidatedConfig):
    """A rectangular room with four walls.

    Attributes:
        size_m: Inner extent along x, y and z.
        at_m: `(x, y)` of the middle of its floor.
        floor: Name of the look of the floor.
        walls: Name of the look of the walls.
        ceiling: Name of the look of the ceiling.
        openings: Doors and windows. Rooms beside each other need a door each, at the same place.
        pictures: Number of pictures on its walls; where they hang, the seed chooses.
        wall_m: Thickness of the walls, outside of `size_m`.
    """

    size_m: tuple[Length, Length, Length]
    at_m: Plan = (0.0, 0.0)
    floor: str = "planks"
    walls: str = "plaster"
    ceiling: str = "white"
    openings: tuple[Opening, ...] = ()
    pictures: Annotated[int, Range(at_least=0, at_most=40)] = 6
    wall_m: Length = 0.1


@dataclass(frozen=True)
class Lighting(ValidatedConfig):
    """Light from one direction, and from everywhere.

    Attributes:
        from_m: Direction that the directional light comes from; any length.
        brightness: Factor of all light.
        ambient: Share of the light that comes from everywhere.
        lamp_m: Place of a lamp around which all light fades; `None` for light that is the same everywhere.
        reach_m: Distance from the lamp at which half of the light is left.
    """

    from_m: Point = (-0.45, 0.30, 0.84)
    brightness: Length = 1.1
    ambient: Annotated[float, Share] = 0.5
    lamp_m: Point | None = None
    reach_m: Length = 4.2

    def __post_init__(self) -> None:
        super().__post_init__()
        if not any(self.from_m):
            raise ConfigError(f"Lighting.from_m: expected a direction, got {self.from_m}")


@dataclass(frozen=True)
class Exposure(ValidatedConfig):
    """Brightness of the pictures from a time on.

    Attributes:
        at_s: The time.
        factor: Factor of brightness, compared with the lighting.
        over_s: Time in which the factor changes to this one.
    """

    at_s: Annotated[float, Range(at_least=0)]
    factor: Annotated[float, Range(at_least=0, at_most=100)]
    over_s: Annotated[float, Range(at_least=0)] = 0.0


@dataclass(frozen=True)
class Fault(ValidatedConfig):
    """Time in which the camera does not deliver pictures as it should.

    Attributes:
        from_s: Its beginning.
        until_s: Its end.
        pictures: `missing`: there are no frames; `black`: frames are black and without depth; `frozen`: all are the
            last one before.
    """

    from_s: Annotated[float, Range(at_least=0)]
    until_s: Annotated[float, Positive]
    pictures: Literal["missing", "black", "frozen"] = "missing"

    def __post_init__(self) -> None:
        super().__post_init__()
        _check_span("Fault", self.from_s, self.until_s)


@dataclass(frozen=True)
class Way(ValidatedConfig):
    """The way of the camera: through points, held by a hand, or that of a trajectory in a file.

    Attributes:
        points_m: Points `(x, y, z)` it passes; at least two, or none with a `file`.
        file: File of a trajectory of the camera in the layout of TUM RGB-D, KITTI or EuRoC, z up; splines go through
            its poses. Of the other fields only the next two and `at_m`, `turn_deg`, `from_s` and `tremor` count then.
        T_body_cam: `(7,)` wxyz_xyz pose of the camera in the axes of the body whose poses the file holds.
        smooth_s: Time over which the poses of the file are averaged, against the noise of a motion capture; 0 for none.
        at_m: Place of the trajectory's origin in the world.
        turn_deg: Turn of the trajectory about the vertical.
        from_s: Time on the way, or in the trajectory, at which the recording begins.
        speed_m_per_s: Speed along the way.
        ends: At the last point: `back` to the first one and on, round in a `loop`, or `stop`.
        pause_s: Time of rest at the first and the last point.
        look: `ahead` along the way, or the point `(x, y, z)` it looks at.
        turn_s: Time over which it turns at a corner, looking ahead.
        down_deg: Angle by which it looks down from ahead.
        swing_deg: Amplitude by which it looks left and right from ahead, with a period of eight seconds.
        tremor: Factor of the tremor of the hand: 1 for 2 mm and 0.15 degrees; 0 for none.
    """

    points_m: tuple[Point, ...] = ()
    file: str | None = None
    T_body_cam: Pose = (1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    smooth_s: Annotated[float, Range(at_least=0)] = 0.0
    at_m: Point = (0.0, 0.0, 0.0)
    turn_deg: float = 0.0
    from_s: Annotated[float, Range(at_least=0)] = 0.0
    speed_m_per_s: Annotated[float, Range(above=0, at_most=100)] = 0.5
    ends: Literal["back", "loop", "stop"] = "back"
    pause_s: Annotated[float, Range(at_least=0)] = 0.0
    look: Literal["ahead"] | Point = "ahead"
    turn_s: Length = 2.4
    down_deg: Annotated[float, Range(at_least=-90, at_most=90)] = 8.0
    swing_deg: Annotated[float, Range(at_least=0, at_most=180)] = 0.0
    tremor: Annotated[float, Range(at_least=0)] = 1.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.file is None:
            _check_points("Way.points_m", self.points_m)
        elif self.points_m:
            raise ConfigError("Way: expected points_m or a file, got both")
        length = math.hypot(*self.T_body_cam[:4])
        if abs(length - 1.0) > _UNIT_TOLERANCE:
            raise ConfigError(f"Way.T_body_cam: expected a quaternion of length 1, then a place, got length {length:g}")


@dataclass(frozen=True)
class WorldCamera(ValidatedConfig):
    """The camera that films a world.

    Attributes:
        width: Pixels of a row.
        height: Pixels of a column.
        fps: Frames a second.
        fx: Focal length in pixels, along rows; `None` for `525 * width / 640`.
        fy: Focal length in pixels, along columns; `None` for `fx`.
        cx: Column of the principal point, from the center of the first pixel; `None` for the middle.
        cy: Row of the principal point, from the center of the first pixel; `None` for the middle.
        baseline_m: Baseline of a rectified stereo pair; `None` for a camera that measures depth.
        sensor: Its faults.
    """

    width: Annotated[int, Range(at_least=8, at_most=8192)] = 640
    height: Annotated[int, Range(at_least=8, at_most=8192)] = 480
    fps: Annotated[float, Range(above=0, at_most=1000)] = 30.0
    fx: Length | None = None
    fy: Length | None = None
    cx: float | None = None
    cy: float | None = None
    baseline_m: Annotated[float, Range(above=0, at_most=10)] | None = None
    sensor: SensorConfig = field(default_factory=SensorConfig)


@dataclass(frozen=True)
class RealPeople(ValidatedConfig):
    """People of a real recording with depth, cut out by a network and set by their depth into the pictures.

    Paths begin with `$JAXSLAM_DATA/` or `$JAXSLAM_MODELS/`, or are relative to the description's folder.

    Attributes:
        recording: Folder of the recording.
        network: File of an ONNX network that gives masks of people.
        from_s: Time in the recording at the start of the world's.
        mirrored: Whether left and right of the recording are exchanged.
    """

    recording: str
    network: str
    from_s: Annotated[float, Range(at_least=0)] = 0.0
    mirrored: bool = False


@dataclass(frozen=True)
class World(ValidatedConfig):
    """A world: places, what is in them, light, and how it is filmed.

    Attributes:
        about: What it shows, in a sentence.
        seconds: Length of the recording.
        way: The way of the camera.
        seed: Chooses textures, clothes, pictures, tremor and noise.
        rooms: The rooms.
        things: Things that stand or move.
        people: People.
        real_people: People of a real recording; `None` for none.
        kinds: Kinds of things beside those of the catalog, by name.
        looks: Looks beside those of the catalog, by name.
        backdrop: Name of the look of what lies behind everything: the sky, or the dark behind an open door.
        lighting: The light.
        exposure: Changes of the brightness of the pictures, in the order of time.
        faults: Times in which the camera does not deliver.
        camera: The camera.
        scale: Factor of all lengths and speeds of the world, and of the ranges and noise of the sensor: pictures stay
            the same, and depth and poses grow.
    """

    about: str
    seconds: Annotated[float, Range(above=0, at_most=86400)]
    way: Way
    seed: Annotated[int, Range(at_least=0, below=2**31)] = 0
    rooms: tuple[Room, ...] = ()
    things: tuple[Thing, ...] = ()
    people: tuple[Person, ...] = ()
    real_people: RealPeople | None = None
    kinds: Mapping[str, Kind] = field(default_factory=dict)
    looks: Mapping[str, Look] = field(default_factory=dict)
    backdrop: str = "dusk"
    lighting: Lighting = field(default_factory=Lighting)
    exposure: tuple[Exposure, ...] = ()
    faults: tuple[Fault, ...] = ()
    camera: WorldCamera = field(default_factory=WorldCamera)
    scale: Annotated[float, Range(at_least=0.01, at_most=100)] = 1.0

    def __post_init__(self) -> None:
        super().__post_init__()
        times = [change.at_s for change in self.exposure]
        if times != sorted(times):
            raise ConfigError(f"World.exposure: expected times in order, got {times}")
        if self.real_people is not None:
            _check_with_real_people(self)


@dataclass(frozen=True)
class Catalog(ValidatedConfig):
    """Looks and kinds of things that any world can use.

    Attributes:
        looks: Looks by name.
        kinds: Kinds by name.
    """

    looks: Mapping[str, Look]
    kinds: Mapping[str, Kind]


def _check_with_real_people(world: World) -> None:
    """Refuse what pictures of real people cannot follow.

    Raises:
        ConfigError: The camera is a stereo pair, or the exposure changes.
    """
    if world.camera.baseline_m is not None:
        got = f"a stereo pair (baseline_m {world.camera.baseline_m:g})"
        raise ConfigError(f"World.real_people: expected a camera with depth, got {got}")
    if world.exposure:
        raise ConfigError("World.exposure: expected none with real_people, whose colors are as recorded, got some")


def _check_span(of: str, from_s: float, until_s: float | None) -> None:
    if until_s is not None and until_s <= from_s:
        raise ConfigError(f"{of}.until_s: expected more than from_s, {from_s}, got {until_s}")


def _check_points(name: str, points: tuple[tuple[float, ...], ...]) -> None:
    """Refuse a way of fewer than two points, or with a point twice in a row.

    Raises:
        ConfigError: If it is one.
    """
    if len(points) < 2:
        raise ConfigError(f"{name}: expected at least two points, got {len(points)}")
    for first, second in itertools.pairwise(points):
        if first == second:
            raise ConfigError(f"{name}: expected different points in a row, got {first} twice")
