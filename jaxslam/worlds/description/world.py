"""The description of a whole world."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated

from jaxslam.config.validation import Range, ValidatedConfig
from jaxslam.errors import ConfigError
from jaxslam.worlds.description.filming import Fault, Way, WorldCamera, WorldImu
from jaxslam.worlds.description.light import Exposure, LightChange, Lighting
from jaxslam.worlds.description.places import Place, Road, Room
from jaxslam.worlds.description.things import Group, Hand, Kind, Look, Person, Thing
from jaxslam.worlds.description.units import Length


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


def _check_real_imu(way: Way, scale: float) -> None:
    """Refuse a way on which a real IMU has not been."""
    if way.file is None or way.tremor or scale != 1:
        got = f"file {way.file}, tremor {way.tremor:g} and scale {scale:g}"
        raise ConfigError(f"WorldImu.file: expected a way.file with way.tremor 0 and a World.scale of 1, got {got}")
