"""Places: rooms, roads, and other worlds in a world."""

from dataclasses import dataclass
from typing import Annotated, Literal

from jaxslam.config.validation import Positive, Range, Share, ValidatedConfig
from jaxslam.errors import ConfigError
from jaxslam.worlds.description.units import Length, Plan, Side, check_points


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
        check_points("Road.points_m", self.points_m)


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
