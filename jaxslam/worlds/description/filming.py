"""Filming: the way of the camera, the camera, its faults, and the IMU beside it."""

import math
from dataclasses import dataclass, field
from typing import Annotated, Literal

from jaxslam.config.validation import Positive, Range, ValidatedConfig
from jaxslam.datasets.synthetic.sensor_noise import SensorConfig
from jaxslam.errors import ConfigError
from jaxslam.worlds.description.units import Ends, Length, Plan, Point, Pose, check_span, check_way

_UNIT_TOLERANCE = 1e-3
"""Difference from 1 of the length of a quaternion that is written with few digits."""


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
        flies: Whether a multirotor carries it, which leans into its acceleration.
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
    flies: bool = False
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
        check_way("Way", self.points_m, self.file or self.along, "a file" if self.file else "along")
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
        check_span("Fault", self.from_s, self.until_s)


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
