"""Light and the brightness of pictures, at first and later."""

from dataclasses import dataclass
from typing import Annotated

from jaxslam.config.validation import Range, Share, ValidatedConfig
from jaxslam.errors import ConfigError
from jaxslam.worlds.description.units import Length, Point


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
