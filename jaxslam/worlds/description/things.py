"""Things and people: how they look, what they are made of, where they are and how they move."""

from dataclasses import dataclass
from typing import Annotated, Literal

from jaxslam.config.validation import Positive, Range, Share, ValidatedConfig
from jaxslam.errors import ConfigError
from jaxslam.worlds.description.units import Color, Ends, Length, Plan, Point, check_span, check_way


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
        check_way("Route", self.points_m, self.along, "along")


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
        check_span("Thing", self.from_s, self.until_s)


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
        check_span("Person", self.from_s, self.until_s)
        if self.sits and (self.route is not None or self.carries is not None):
            raise ConfigError("Person.sits: expected one who neither walks nor carries, got a route or carries")


@dataclass(frozen=True)
class Group(ValidatedConfig):
    """People who come from all or some sides, stand together facing each other, and part again.

    Attributes:
        people: Number of people.
        at_m: `(x, y)` of the middle of the place where they stand.
        radius_m: Distance from the middle at which they stand.
        come_from_m: Distance from the middle at which they begin and to which they go.
        meet_s: Time at which the first one arrives; the others follow within three seconds.
        stay_s: Time for which each of them stands there, then goes back and comes again after as long.
        speed_m_per_s: Speed at which they walk.
        come_from_deg: Directions from which they come, in turn, from x toward y, such as `[0, 180]` along a corridor;
            empty for all sides. They come side by side, so `come_from_m` is how far along the direction.
    """

    people: Annotated[int, Range(at_least=1, at_most=40)]
    at_m: Plan = (0.0, 0.0)
    radius_m: Length = 0.9
    come_from_m: Length = 3.0
    meet_s: Annotated[float, Range(at_least=0)] = 5.0
    stay_s: Annotated[float, Range(at_least=0)] = 6.0
    speed_m_per_s: Annotated[float, Range(above=0, at_most=5)] = 1.0
    come_from_deg: tuple[float, ...] = ()

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
        check_span("Hand", self.from_s, self.until_s)
