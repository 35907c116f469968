"""Sensor model of a Kinect-like camera: noise, holes and quantization, each with its own switch."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Annotated, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxslam_kernels.program_parts import apart
from jaxtyping import Array, Bool, Float, Int, UInt, UInt8

from jaxslam.config.validation import Range, ValidatedConfig
from jaxslam.datasets.synthetic.noise import normal_noise
from jaxslam.datasets.synthetic.shading import unpack_color
from jaxslam.errors import ConfigError
from jaxslam.runtime.compiled import compiled
from jaxslam.runtime.compiler_options import FUSION_EMITTERS, SINGLE_THREAD


@dataclass(frozen=True)
class SensorConfig(ValidatedConfig):
    """The faults of the camera; the value that turns each one off stands beside it.

    Attributes:
        depth_noise_per_m: Standard deviation of the inverse depth, so that depth z has `depth_noise_per_m * z**2`
            (Khoshelham & Elberink 2012, eq. 9: 1.4 mm at 1 m, 2.3 cm at 4 m). 0: no noise.
        depth_step_per_m: Step of the inverse depth, from disparities of an eighth of a pixel (same paper, section
            4.3: 2.85 mm at 1 m, 4.6 cm at 4 m). 0: continuous.
        depth_unit_m: Step of the depth itself, as image files hold it. 0: continuous.
        shadow_baseline_m: Distance to the infrared projector; what it cannot see has no depth. 0: no shadows.
        edge_jump: Relative jump of the depth within 3 x 3 pixels beyond which there is no depth. 0: none is lost.
        max_incidence_deg: Angle from the surface normal beyond which there is no depth. 90: none is lost.
        min_depth_m: Depth below which there is none. 0: no limit.
        max_depth_m: Depth above which there is none. 1000: no limit, in a room.
        exposure_s: Time over which the moving picture is integrated, color only. 0: no motion blur.
        exposure_samples: Odd number of moments that are averaged, each at another place in the pixel, which smooths
            edges as well. 1: neither blur nor smooth edges.
        gain_swing: Relative change of brightness as the automatic exposure wanders. 0: constant.
        image_noise: Standard deviation of the noise of each channel in gray levels. 0: none.
    """

    depth_noise_per_m: Annotated[float, Range(at_least=0, at_most=1)] = 1.425e-3
    depth_step_per_m: Annotated[float, Range(at_least=0, at_most=1)] = 2.85e-3
    depth_unit_m: Annotated[float, Range(at_least=0, at_most=1)] = 1 / 5000
    shadow_baseline_m: Annotated[float, Range(at_least=0, at_most=1)] = 0.075
    edge_jump: Annotated[float, Range(at_least=0)] = 0.05
    max_incidence_deg: Annotated[float, Range(above=0, at_most=90)] = 82.0
    min_depth_m: Annotated[float, Range(at_least=0)] = 0.4
    max_depth_m: Annotated[float, Range(above=0)] = 5.0
    exposure_s: Annotated[float, Range(at_least=0, at_most=1)] = 0.015
    exposure_samples: Annotated[int, Range(at_least=1, at_most=31)] = 3
    gain_swing: Annotated[float, Range(at_least=0, below=1)] = 0.12
    image_noise: Annotated[float, Range(at_least=0, at_most=100)] = 2.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.exposure_samples % 2 == 0:
            got = f"{self.exposure_samples}: one moment is the frame's own"
            raise ConfigError(f"SensorConfig.exposure_samples: expected an odd integer, got {got}")


def scaled_sensor(config: SensorConfig, factor: float) -> SensorConfig:
    """The same camera for a scene whose lengths are times a factor: it measures the same, times that factor."""
    return replace(
        config,
        depth_noise_per_m=config.depth_noise_per_m / factor,
        depth_step_per_m=config.depth_step_per_m / factor,
        depth_unit_m=config.depth_unit_m * factor,
        shadow_baseline_m=config.shadow_baseline_m * factor,
        min_depth_m=config.min_depth_m * factor,
        max_depth_m=config.max_depth_m * factor,
    )


PERFECT_SENSOR = SensorConfig(
    depth_noise_per_m=0.0,
    depth_step_per_m=0.0,
    depth_unit_m=0.0,
    shadow_baseline_m=0.0,
    edge_jump=0.0,
    max_incidence_deg=90.0,
    min_depth_m=0.0,
    max_depth_m=1000.0,
    exposure_s=0.0,
    gain_swing=0.0,
    image_noise=0.0,
)
"""No faults but eight bits a channel; edges are still smooth."""


class DepthParams(NamedTuple):
    """Faults of depth as scalars that can change without recompiling; the angle as its cosine."""

    depth_noise_per_m: float
    depth_step_per_m: float
    depth_unit_m: float
    shadow_baseline_m: float
    edge_jump: float
    min_cosine: float
    min_depth_m: float
    max_depth_m: float


class LensParams(NamedTuple):
    """Faults of lens and amplifier.

    Attributes:
        vignetting: Share of the light that is missing in the corners of the picture.
        gamma: Exponent by which brightness is `brightness ** (1 / gamma)`.
    """

    vignetting: float
    gamma: float


def depth_params(config: SensorConfig) -> DepthParams:
    """Return the numbers of a configuration that `measure_depth` takes."""
    return DepthParams(
        config.depth_noise_per_m,
        config.depth_step_per_m,
        config.depth_unit_m,
        config.shadow_baseline_m,
        config.edge_jump,
        float(np.cos(np.deg2rad(config.max_incidence_deg))) if config.max_incidence_deg < 90.0 else -1.0,
        config.min_depth_m,
        config.max_depth_m,
    )


@compiled(when="first use", static=("height", "width"), options=FUSION_EMITTERS | SINGLE_THREAD)
def measure_color(
    exposures: tuple[UInt[Array, "rows columns h w"], ...],
    first: int,
    gain: float | np.ndarray,
    image_noise: float,
    key: Array,
    lens: LensParams | None = None,
    *,
    height: int,
    width: int,
) -> UInt8[Array, "3 rows columns h w"]:
    """Return red, green and blue of eight bits, in tiles as they were rendered: pixels have no neighbors here.

    Args:
        exposures: Packed colors at the moments that are averaged: rows of tiles of the picture.
        first: First row of tiles.
        gain: Brightness factor of this frame, or of each row, `(1, rows, 1, h, 1)`.
        image_noise: Standard deviation of the noise in gray levels.
        key: Random key of this frame.
        lens: Faults of the lens; `None` for none.
        height: Rows of the picture, static.
        width: Columns of the picture, static.
    """
    # All in one type: a recording is the same bytes where float64 is enabled.
    numbers = (gain, image_noise, lens)
    gain, image_noise, lens = jax.tree.map(lambda number: jnp.asarray(number, jnp.float32), numbers)
    color_key, _ = jax.random.split(key)
    mean = sum(map(unpack_color, exposures[1:]), start=unpack_color(exposures[0])) / len(exposures)
    rows, columns, tile_height, tile_width = exposures[0].shape
    v = (first + jnp.arange(rows))[:, None] * tile_height + jnp.arange(tile_height)[None]
    v, u = v.reshape(rows, 1, tile_height, 1), jnp.arange(columns * tile_width).reshape(1, columns, 1, tile_width)
    planes = jnp.arange(3, dtype=jnp.uint32).reshape(3, 1, 1, 1, 1) * np.uint32(height * width)
    places = planes + (v * width + u).astype(jnp.uint32)[None]
    noise = image_noise * normal_noise(color_key, places)
    if lens is None:
        bright = 255.0 * gain * mean
    else:
        bright = 255.0 * _through_lens(gain * mean, _place(v, height), _place(u, width), height, width, lens)
    return jnp.clip(jnp.round(bright + noise), 0.0, 255.0).astype(jnp.uint8)


@compiled(when="first use", options=FUSION_EMITTERS | SINGLE_THREAD)
def measure_depth(
    depth_m: Float[Array, "h w"], incidence: Float[Array, "h w"], fx: float, params: DepthParams, key: Array
) -> Float[Array, "h w"]:
    """Return depth in meters, 0 where missing.

    Args:
        depth_m: Exact depth.
        incidence: Cosine of the angle between ray and surface normal.
        fx: Focal length in pixels.
        params: From `depth_params`.
        key: Random key of this frame.
    """
    # All in the depth's type: a recording is the same bytes where float64 is enabled.
    fx, params = jax.tree.map(lambda number: jnp.asarray(number, depth_m.dtype), (fx, params))
    # Else XLA makes the noise again for each of its uses, and leaves the thread that called it.
    lit = apart(lambda: _lit(depth_m, fx, params.shadow_baseline_m))
    on_edge = apart(lambda: _on_edge(depth_m, params.edge_jump))
    kept = _inside_limits(depth_m, incidence, params) & lit & ~on_edge
    places = jax.lax.iota(jnp.uint32, depth_m.size).reshape(depth_m.shape)
    noise = apart(lambda: normal_noise(jax.random.split(key)[1], places))
    measured = _noisy_depth(depth_m, noise, params)
    return jnp.where(kept, measured, 0.0)


def _place(index: Int[Array, "..."], count: int) -> Float[Array, "..."]:
    """Pixels from the middle of the picture to a row or column of `count`."""
    from_middle = jnp.linspace(-1.0, 1.0, count, dtype=jnp.float32) * (0.5 * count)
    return from_middle[jnp.minimum(index, count - 1)]


def _through_lens(light: Array | np.ndarray, v: Array, u: Array, height: int, width: int, lens: LensParams) -> Array:
    """Brightness as amplified, darker the farther from the middle of the picture."""
    corner = 0.25 * (height**2 + width**2)
    kept = 1.0 - lens.vignetting * (v**2 + u**2) / corner
    return jnp.maximum(kept[None] * light, 0.0) ** (1.0 / lens.gamma)


def _inside_limits(
    depth_m: Float[Array, "h w"], incidence: Float[Array, "h w"], params: DepthParams
) -> Bool[Array, "h w"]:
    within = (depth_m >= params.min_depth_m) & (depth_m <= params.max_depth_m)
    return within & (incidence > params.min_cosine)


def _noisy_depth(depth_m: Float[Array, "h w"], noise: Float[Array, "h w"], params: DepthParams) -> Float[Array, "h w"]:
    """Noise and steps of the inverse depth, which disparity is proportional to; then steps of the depth."""
    inverse = 1.0 / depth_m + params.depth_noise_per_m * noise
    return _rounded(1.0 / jnp.maximum(_rounded(inverse, params.depth_step_per_m), 1e-3), params.depth_unit_m)


def _rounded(values: Float[Array, "h w"], step: float) -> Float[Array, "h w"]:
    return jnp.where(step > 0.0, jnp.round(values / jnp.maximum(step, 1e-9)) * step, values)


def _lit(depth_m: Float[Array, "h w"], fx: float, baseline_m: float) -> Bool[Array, "h w"]:
    """Whether the projector, `baseline_m` to the right of the camera, sees what each pixel sees.

    Seen from there, points of a row appear in the order of the row, except those that something hides.
    """
    column = jnp.arange(depth_m.shape[1], dtype=depth_m.dtype)[:, None]
    from_projector = column - fx * baseline_m / depth_m.T

    def step(leftmost: Array, places: Array) -> tuple[Array, Array]:
        leftmost = jnp.minimum(leftmost, places)
        return leftmost, places <= leftmost

    # From right to left, all rows at once: a quarter of the time of `lax.cummin`.
    return jax.lax.scan(step, from_projector[-1], from_projector, reverse=True)[1].T


def _on_edge(depth_m: Float[Array, "h w"], jump: float) -> Bool[Array, "h w"]:
    """Whether the depth varies too much among the pixel and its eight neighbors."""
    padded = jnp.pad(depth_m, 1, mode="edge")
    spread = _over_nine(padded, jnp.maximum) - _over_nine(padded, jnp.minimum)
    return (spread > jump * depth_m) & (jump > 0.0)


def _over_nine(padded: Array, pick: Callable[[Array, Array], Array]) -> Array:
    """Combine the nine pixels around each; shifted slices take a quarter of the time of `lax.reduce_window`."""
    tall = pick(pick(padded[:-2], padded[1:-1]), padded[2:])
    return pick(pick(tall[:, :-2], tall[:, 1:-1]), tall[:, 2:])
