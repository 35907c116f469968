"""Camera and depth noise as compiled programs take them: the traced part of a sensor."""

from typing import NamedTuple

import jax.numpy as jnp
from jax.typing import DTypeLike
from jaxslam_kernels.camera import Intrinsics
from jaxslam_kernels.types import Scalar

from jaxslam.config.schema import TrackConfig
from jaxslam.runtime.floating_dtype import floating_dtype
from jaxslam.sensors.camera import Camera

_STEP_SIGMAS, _STEP_BASELINES = 4.0, 0.2
"""Step of depth that counts as no edge at any depth: standard deviations close to a depth camera (2 cm by default), and
baselines of a pair. Without it, 160 columns give too few points, and the rendered stereo room has 2.06 mm, not 1.80."""


class SensorModel(NamedTuple):
    """A camera that measures depth, or a stereo pair: traced, so any field can change without recompiling.

    Attributes:
        intrinsics: Pinhole camera with distortion; of a stereo pair, the left one.
        readout_s: Time from the first row to the last of a rolling shutter, seconds; 0 for a global shutter.
        depth_sigma_m: Standard deviation of measured depth close to the camera, meters.
        depth_sigma_per_m2: Growth of that standard deviation with the square of depth, 1 / m (Khoshelham and Elberink
            2012). Both include the errors that neighboring pixels share, so they are larger than the noise of a single
            pixel.
        min_depth_m: Smallest measured depth that counts as valid, meters.
        max_depth_m: Largest measured depth that counts as valid, meters.
        baseline_m: Distance from the left to the right camera of a rectified pair, meters; 0 for a camera that
            measures depth.
    """

    intrinsics: Intrinsics
    readout_s: Scalar
    depth_sigma_m: Scalar
    depth_sigma_per_m2: Scalar
    min_depth_m: Scalar
    max_depth_m: Scalar
    baseline_m: Scalar

    def depth_step_m(self) -> Scalar:
        """Return the step between neighboring depths that noise alone makes on any surface, meters."""
        return _STEP_SIGMAS * self.depth_sigma_m + _STEP_BASELINES * self.baseline_m

    def for_readout(self, sign: Scalar | None) -> "SensorModel":
        """Return the model with the direction in which a frame's rolling shutter reads the rows.

        Args:
            sign: 1 for the first row first, -1 for the last row first; `None` for 1. See `FrameArrays`.
        """
        return self if sign is None else self._replace(readout_s=self.readout_s * sign)


class DepthNoise(NamedTuple):
    """Standard deviation of measured depth: `sigma_m + sigma_per_m2 z^2` at depth `z`.

    Attributes:
        sigma_m: Standard deviation close to the camera, meters.
        sigma_per_m2: Growth of the standard deviation with the square of depth, 1 / m.
    """

    sigma_m: float
    sigma_per_m2: float


def depth_noise(camera: Camera, config: TrackConfig) -> DepthNoise:
    """Give the depth noise of a sensor.

    Args:
        camera: The camera or stereo pair. The depth noise of a pair is that of its disparity, to first order.
        config: Settings of the tracker, which hold the noise of a depth sensor and that of a disparity.
    """
    if camera.baseline_m is None or not camera.is_stereo:
        return DepthNoise(config.depth_sigma_m, config.depth_sigma_per_m2)
    return DepthNoise(0.0, config.disparity_sigma_px / (camera.fx * camera.baseline_m))


def min_valid_depth(camera: Camera, config: TrackConfig) -> float:
    """Give the smallest valid depth of a sensor, meters.

    Args:
        camera: The camera or stereo pair. The limit of a pair is a number of baselines.
        config: Settings of the tracker, which hold the limit of a depth sensor and the number of baselines.
    """
    if camera.baseline_m is None or not camera.is_stereo:
        return config.min_depth_m
    return config.near_baselines * camera.baseline_m


def max_valid_depth(camera: Camera, config: TrackConfig) -> float:
    """Give the largest valid depth of a sensor, meters.

    Args:
        camera: The camera or stereo pair. A pair has its own limit: that of its file, or a number of baselines.
        config: Settings of the tracker, which hold the limit of a depth sensor and the number of baselines.
    """
    if camera.baseline_m is None or not camera.is_stereo:
        return config.max_depth_m
    return camera.far_depth_m or config.far_baselines * camera.baseline_m


def sensor_model(camera: Camera, config: TrackConfig, dtype: DTypeLike = jnp.float32) -> SensorModel:
    """Make the sensor model of a camera or stereo pair.

    Args:
        camera: The camera or stereo pair.
        config: Settings of the tracker, of which those of the sensor are taken.
        dtype: Floating-point type of every parameter; float32 if not given, also with `jax_enable_x64`.

    Raises:
        TypeError: If `dtype` is no floating-point type, or is float64 while `jax_enable_x64` is off.
    """
    dtype, noise = floating_dtype(dtype), depth_noise(camera, config)
    baseline_m = camera.baseline_m if camera.baseline_m is not None and camera.is_stereo else 0.0
    return SensorModel(
        intrinsics=camera.intrinsics(dtype),
        readout_s=jnp.asarray(camera.readout_s, dtype),
        depth_sigma_m=jnp.asarray(noise.sigma_m, dtype),
        depth_sigma_per_m2=jnp.asarray(noise.sigma_per_m2, dtype),
        min_depth_m=jnp.asarray(min_valid_depth(camera, config), dtype),
        max_depth_m=jnp.asarray(max_valid_depth(camera, config), dtype),
        baseline_m=jnp.asarray(baseline_m, dtype),
    )
