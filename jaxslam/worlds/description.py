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

Ends: TypeAlias = Literal["back", "reverse", "loop", "stop"]
"""What happens at the last point of a way."""

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
        points_m: Points `(x, y)` on the floor; at least two, or none with `along`.
        speed_m_per_s: Speed along the way.
        ends: At the last point: `back` to the first one and on, `reverse` to it without turning, round in a `loop` to
            the first one and on, or `stop`.
        pause_s: Time of rest at the first and the last point; with `loop`, at the first one.
        delay_s: Time at the first point before it begins; what has no `stop` is so far behind on its way instead.
        backward: Whether it goes backward, as a car that reverses.
        along: Name of the road it goes along; `None` for a way through points.
        beside_m: Distance from the middle of the road, positive on its left side; or pairs of a distance along the
            road and one from its middle, with straight lines between them, for a change of lanes.
        from_m: Distance along the road at which it begins.
        until_m: Distance along the road at which it ends; `None` for the end of the road. With less than `from_m` it
            goes against the direction of the road.
    """

    points_m: tuple[Plan, ...] = ()
    speed_m_per_s: Annotated[float, Range(above=0, at_most=100)] = 1.0
    ends: Ends = "back"
    pause_s: Annotated[float, Range(at_least=0)] = 0.0
    delay_s: Annotated[float, Range(at_least=0)] = 0.0
    backward: bool = False
    along: str | None = None
    beside_m: float | tuple[Plan, ...] = 0.0
    from_m: Annotated[float, Range(at_least=0)] = 0.0
    until_m: Annotated[float, Range(at_least=0)] | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        _check_way("Route", self.points_m, self.along, "along")


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
    """A person who walks a route, stands or sits.

    Attributes:
        at_m: `(x, y)` of one who stands or sits.
        turn_deg: Direction that one who stands or sits faces.
        route: The way of one who walks; `None` for one who does not.
        sits: Whether the person sits, at the height of a chair, sways, looks about and raises an arm now and then.
        carries: Name of the kind of thing that the person carries before the chest; `None` for nothing.
        from_s: Time at which the person appears.
        until_s: Time at which the person is gone; `None` for never.
    """

    at_m: Plan = (0.0, 0.0)
    turn_deg: float = 0.0
    route: Route | None = None
    sits: bool = False
    carries: str | None = None
    from_s: Annotated[float, Range(at_least=0)] = 0.0
    until_s: Annotated[float, Positive] | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        _check_span("Person", self.from_s, self.until_s)
        if self.sits and (self.route is not None or self.carries is not None):
            raise ConfigError("Person.sits: expected one who neither walks nor carries, got a route or carries")


@dataclass(frozen=True)
class Group(ValidatedConfig):
    """People who come from all sides, stand together facing each other, and part again.

    Attributes:
        people: Number of people.
        at_m: `(x, y)` of the middle of the place where they stand.
        radius_m: Distance from the middle at which they stand.
        come_from_m: Distance from the middle at which they begin and to which they go.
        meet_s: Time at which the first one arrives; the others follow within three seconds.
        stay_s: Time for which each of them stands there, then goes back and comes again after as long.
        speed_m_per_s: Speed at which they walk.
    """

    people: Annotated[int, Range(at_least=1, at_most=40)]
    at_m: Plan = (0.0, 0.0)
    radius_m: Length = 0.9
    come_from_m: Length = 3.0
    meet_s: Annotated[float, Range(at_least=0)] = 5.0
    stay_s: Annotated[float, Range(at_least=0)] = 6.0
    speed_m_per_s: Annotated[float, Range(above=0, at_most=5)] = 1.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.come_from_m <= self.radius_m:
            got = f"{self.come_from_m:g}"
            raise ConfigError(f"Group.come_from_m: expected more than radius_m, {self.radius_m:g}, got {got}")


@dataclass(frozen=True)
class Hand(ValidatedConfig):
    """A hand that comes before the lens from below, stays and goes.

    Attributes:
        from_s: Time at which it begins to come.
        until_s: Time at which it is gone.
        before_m: Distance from the camera.
        covers: Share of the height of the picture that it reaches up to.
    """

    from_s: Annotated[float, Range(at_least=0)]
    until_s: Annotated[float, Positive]
    before_m: Annotated[float, Range(at_least=0.1, at_most=1)] = 0.2
    covers: Annotated[float, Range(above=0, at_most=1)] = 0.7

    def __post_init__(self) -> None:
        super().__post_init__()
        _check_span("Hand", self.from_s, self.until_s)


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
class Row(ValidatedConfig):
    """Things in a row beside a road.

    Attributes:
        kinds: Names of kinds; the seed chooses among them.
        every_m: Distance along the road from one place to the next.
        beside_m: Distance from the middle of the road.
        side: Side of the road.
        share: Probability that something stands in a place.
        vary_m: Largest shift from the place, along the road and across it.
        turn_deg: Direction that they face; 0 faces the road, and -90 is that of traffic on the right.
        vary_deg: Largest turn from there.
        scale: Smallest and largest factor of their size.
        from_m: Distance along the road at which the row begins.
        until_m: Distance along the road at which it ends; `None` for the end of the road.
    """

    kinds: tuple[str, ...]
    every_m: Length
    beside_m: Annotated[float, Range(at_least=0)]
    side: Literal["left", "right", "both"] = "both"
    share: Annotated[float, Share] = 1.0
    vary_m: Plan = (0.0, 0.0)
    turn_deg: float = 0.0
    vary_deg: Annotated[float, Range(at_least=0)] = 0.0
    scale: tuple[Length, Length] = (1.0, 1.0)
    from_m: Annotated[float, Range(at_least=0)] = 0.0
    until_m: Annotated[float, Positive] | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.kinds:
            raise ConfigError("Row.kinds: expected at least one kind, got none")


@dataclass(frozen=True)
class Road(ValidatedConfig):
    """A road on the ground with a dashed line, curbs, sidewalks and what stands beside them.

    Attributes:
        points_m: Points `(x, y)` of its middle; corners become arcs.
        closed: Whether it goes round to the first point; it begins where the arc of the first corner does.
        corner_m: Radius of its middle at corners, less where the points are closer.
        width_m: Distance from curb to curb; 0 for a line on which nothing is but its rows.
        sidewalk_m: Width of the sidewalks; 0 for none.
        curb_m: Height of curbs and sidewalks above the road.
        surface: Name of the look of the road.
        paving: Name of the look of sidewalks and curbs.
        line: Name of the look of the dashed line.
        rows: What stands beside it.
    """

    points_m: tuple[Plan, ...]
    closed: bool = False
    corner_m: Annotated[float, Range(at_least=0)] = 20.0
    width_m: Annotated[float, Range(at_least=0)] = 7.0
    sidewalk_m: Annotated[float, Range(at_least=0)] = 2.0
    curb_m: Annotated[float, Range(at_least=0)] = 0.13
    surface: str = "asphalt"
    paving: str = "concrete"
    line: str = "road paint"
    rows: tuple[Row, ...] = ()

    def __post_init__(self) -> None:
        super().__post_init__()
        _check_points("Road.points_m", self.points_m)


@dataclass(frozen=True)
class Place(ValidatedConfig):
    """Another world that is part of this one: its rooms, roads, things and people.

    Attributes:
        world: Name of the world, or a YAML file beside this one.
        at_m: Where its origin is.
        turn_deg: Its turn: 0, 90, 180 or 270.
    """

    world: str
    at_m: Plan = (0.0, 0.0)
    turn_deg: Literal[0, 90, 180, 270] = 0


@dataclass(frozen=True)
class Lighting(ValidatedConfig):
    """Light from one direction, and from everywhere.

    Attributes:
        from_m: Direction that the directional light comes from; any length.
        brightness: Factor of all light.
        ambient: Share of the light that comes from everywhere.
        lamp_m: Place of a lamp around which all light fades; `None` for light that is the same everywhere.
        reach_m: Distance from the lamp at which half of the light is left.
        flicker: Share by which all light is now less, now more than on average.
        flicker_hz: Frequency of that: 100 or 120 for lamps on mains power.
    """

    from_m: Point = (-0.45, 0.30, 0.84)
    brightness: Length = 1.1
    ambient: Annotated[float, Share] = 0.5
    lamp_m: Point | None = None
    reach_m: Length = 4.2
    flicker: Annotated[float, Share] = 0.0
    flicker_hz: Annotated[float, Range(above=0, at_most=1000)] = 100.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if not any(self.from_m):
            raise ConfigError(f"Lighting.from_m: expected a direction, got {self.from_m}")


@dataclass(frozen=True)
class LightChange(ValidatedConfig):
    """Another light from a time on.

    Attributes:
        at_s: The time.
        light: The light from then on.
        over_s: Time in which one light fades into the other.
    """

    at_s: Annotated[float, Range(at_least=0)]
    light: Lighting
    over_s: Annotated[float, Range(at_least=0)] = 0.0


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
        points_m: Points `(x, y, z)` it passes; at least two, or none with a `file` or `along`.
        file: File of a trajectory of the camera in the layout of TUM RGB-D, KITTI or EuRoC, z up; splines go through
            its poses. Of the other fields only the next two and `at_m`, `turn_deg`, `from_s` and `tremor` count then.
        T_body_cam: `(7,)` wxyz_xyz pose of the camera in the axes of the body whose poses the file holds.
        smooth_s: Time over which the poses of the file are averaged, against the noise of a motion capture; 0 for none.
        at_m: Place of the trajectory's origin in the world.
        turn_deg: Turn of the trajectory about the vertical.
        from_s: Time on the way, or in the trajectory, at which the recording begins.
        speed_m_per_s: Speed along the way.
        ends: At the last point: `back` to the first one and on, `reverse` to it without turning, round in a `loop`, or
            `stop`.
        pause_s: Time of rest at the first and the last point.
        look: `ahead` along the way, or the point `(x, y, z)` it looks at.
        turn_s: Time over which it turns at a corner, looking ahead.
        down_deg: Angle by which it looks down from ahead.
        swing_deg: Amplitude by which it looks left and right from ahead, with a period of eight seconds.
        tremor: Factor of the tremor of the hand: 1 for 2 mm and 0.15 degrees; 0 for none.
        backward: Whether it looks back along the way, as from a car that reverses.
        along: Name of the road it goes along; `None` for a way through points.
        beside_m: See `Route`.
        from_m: See `Route`.
        until_m: See `Route`.
        height_m: Height above the road.
    """

    points_m: tuple[Point, ...] = ()
    file: str | None = None
    T_body_cam: Pose = (1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    smooth_s: Annotated[float, Range(at_least=0)] = 0.0
    at_m: Point = (0.0, 0.0, 0.0)
    turn_deg: float = 0.0
    from_s: Annotated[float, Range(at_least=0)] = 0.0
    speed_m_per_s: Annotated[float, Range(above=0, at_most=100)] = 0.5
    ends: Ends = "back"
    pause_s: Annotated[float, Range(at_least=0)] = 0.0
    look: Literal["ahead"] | Point = "ahead"
    turn_s: Length = 2.4
    down_deg: Annotated[float, Range(at_least=-90, at_most=90)] = 8.0
    swing_deg: Annotated[float, Range(at_least=0, at_most=180)] = 0.0
    tremor: Annotated[float, Range(at_least=0)] = 1.0
    backward: bool = False
    along: str | None = None
    beside_m: float | tuple[Plan, ...] = 0.0
    from_m: Annotated[float, Range(at_least=0)] = 0.0
    until_m: Annotated[float, Range(at_least=0)] | None = None
    height_m: Length = 1.65

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.file is not None and self.along is not None:
            raise ConfigError("Way: expected points_m, a file or along, got a file and along")
        _check_way("Way", self.points_m, self.file or self.along, "a file" if self.file else "along")
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
        rolling_shutter_s: Time from the exposure of the first row to that of the last; 0 if all are taken at once.
        gamma: Exponent by which brightness is `brightness ** (1 / gamma)`; 1 for pictures as bright as the light.
        vignetting: Share of the light that is missing in the corners of the picture.
        sensor: Its other faults.
    """

    width: Annotated[int, Range(at_least=8, at_most=8192)] = 640
    height: Annotated[int, Range(at_least=8, at_most=8192)] = 480
    fps: Annotated[float, Range(above=0, at_most=1000)] = 30.0
    fx: Length | None = None
    fy: Length | None = None
    cx: float | None = None
    cy: float | None = None
    baseline_m: Annotated[float, Range(above=0, at_most=10)] | None = None
    rolling_shutter_s: Annotated[float, Range(at_least=0, at_most=1)] = 0.0
    gamma: Annotated[float, Range(above=0, at_most=5)] = 1.0
    vignetting: Annotated[float, Range(at_least=0, below=1)] = 0.0
    sensor: SensorConfig = field(default_factory=SensorConfig)


def focal_px(camera: WorldCamera) -> float:
    """Return the focal length of a camera in pixels."""
    return 525.0 * camera.width / 640.0 if camera.fx is None else camera.fx


@dataclass(frozen=True)
class WorldImu(ValidatedConfig):
    """The IMU beside the camera: synthesized along the way of the camera, or samples of a real one.

    A figure that is `None` is that of the sheet.

    Attributes:
        sheet: File of a data sheet as `jaxslam.sensors.read_imu_sheet` takes; `None` for `ADIS16448`, EuRoC's IMU.
        rate_hz: Samples per second.
        gyroscope_noise_density: Density of the white noise of angular rates, rad/s/sqrt(Hz).
        gyroscope_random_walk: Density of the random walk of their bias, rad/s^2/sqrt(Hz).
        accelerometer_noise_density: Density of the white noise of specific forces, m/s^2/sqrt(Hz).
        accelerometer_random_walk: Density of the random walk of their bias, m/s^3/sqrt(Hz).
        T_imu_cam: `qw qx qy qz x y z` pose of the camera in IMU axes, meters.
        noise_free: Whether samples are exact: without noise and bias.
        file: File of real samples in the layout of EuRoC's `imu0/data.csv`, plain or `.gz`, on the clock of the
            trajectory in `way.file`.
    """

    sheet: str | None = None
    rate_hz: Annotated[float, Range(above=0, at_most=10_000)] | None = None
    gyroscope_noise_density: Annotated[float, Range(at_least=0)] | None = None
    gyroscope_random_walk: Annotated[float, Range(at_least=0)] | None = None
    accelerometer_noise_density: Annotated[float, Range(at_least=0)] | None = None
    accelerometer_random_walk: Annotated[float, Range(at_least=0)] | None = None
    T_imu_cam: tuple[float, float, float, float, float, float, float] | None = None
    noise_free: bool = False
    file: str | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.file is not None and self.noise_free:
            raise ConfigError("WorldImu: expected noise_free or a file, got both")


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
        places: Other worlds that are part of this one.
        rooms: The rooms.
        roads: Roads by name.
        ground: Name of the look of flat ground everywhere, at height 0; `None` for none.
        things: Things that stand or move.
        people: People.
        groups: People who meet.
        hands: Hands before the lens.
        real_people: People of a real recording; `None` for none.
        kinds: Kinds of things beside those of the catalog, by name.
        looks: Looks beside those of the catalog, by name.
        backdrop: Name of the look of what lies behind everything: the sky, or the dark behind an open door.
        backdrop_m: Distance of the backdrop from everything else.
        lighting: The light at the beginning.
        light_changes: Other light later, in the order of time.
        exposure: Changes of the brightness of the pictures, in the order of time.
        faults: Times in which the camera does not deliver.
        camera: The camera.
        scale: Factor of all lengths and speeds of the world, and of the ranges and noise of the sensor: pictures stay
            the same, and depth and poses grow. Gravity, and the noise of an IMU, stay as they are.
        imu: The IMU; `None` for none.
    """

    about: str
    seconds: Annotated[float, Range(above=0, at_most=86400)]
    way: Way
    seed: Annotated[int, Range(at_least=0, below=2**31)] = 0
    places: tuple[Place, ...] = ()
    rooms: tuple[Room, ...] = ()
    roads: Mapping[str, Road] = field(default_factory=dict)
    ground: str | None = None
    things: tuple[Thing, ...] = ()
    people: tuple[Person, ...] = ()
    groups: tuple[Group, ...] = ()
    hands: tuple[Hand, ...] = ()
    real_people: RealPeople | None = None
    kinds: Mapping[str, Kind] = field(default_factory=dict)
    looks: Mapping[str, Look] = field(default_factory=dict)
    backdrop: str = "dusk"
    backdrop_m: Length = 30.0
    lighting: Lighting = field(default_factory=Lighting)
    light_changes: tuple[LightChange, ...] = ()
    exposure: tuple[Exposure, ...] = ()
    faults: tuple[Fault, ...] = ()
    camera: WorldCamera = field(default_factory=WorldCamera)
    scale: Annotated[float, Range(at_least=0.01, at_most=100)] = 1.0
    imu: WorldImu | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        for name, changes in (("exposure", self.exposure), ("light_changes", self.light_changes)):
            times = [change.at_s for change in changes]
            if times != sorted(times):
                raise ConfigError(f"World.{name}: expected times in order, got {times}")
        if self.imu is not None and self.imu.file is not None:
            _check_real_imu(self.way, self.scale)
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


def _check_way(of: str, points: tuple[tuple[float, ...], ...], other: str | None, name: str) -> None:
    """Refuse a way with neither points nor something else that tells it, or with both.

    Raises:
        ConfigError: If it is one.
    """
    if other is None:
        _check_points(f"{of}.points_m", points)
    elif points:
        raise ConfigError(f"{of}: expected points_m or {name}, got both")


def _check_real_imu(way: Way, scale: float) -> None:
    """Refuse a way on which a real IMU has not been."""
    if way.file is None or way.tremor or scale != 1:
        got = f"file {way.file}, tremor {way.tremor:g} and scale {scale:g}"
        raise ConfigError(f"WorldImu.file: expected a way.file with way.tremor 0 and a World.scale of 1, got {got}")


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
