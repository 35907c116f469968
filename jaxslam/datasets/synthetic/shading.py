"""The color of what each ray of a tile has met.

XLA compiles all that leads to one plane of results into one pass over the tile, and what leads to several planes into
as many passes that repeat each other. So planes are kept apart, not stacked, and a color is one plane: ten bits a
channel in one word, a quarter of what eight bits can show.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Shaped, UInt

from jaxslam.datasets.synthetic.raycast import Plane, Rays, Vectors
from jaxslam.datasets.synthetic.texture import as_surface, texture_color

_LEVELS = 800.0


class Light(NamedTuple):
    """Light of a scene: from one direction, and a lamp around which it fades.

    Attributes:
        towards_sun: Unit vector towards the directional light, in the world.
        lamp_m: Place of the lamp in the world, in meters.
        fading_per_m2: Inverse of the squared distance from the lamp at which half of the light is left; 0 outdoors.
        brightness: Factor of all light.
        ambient: Light that comes from everywhere.
        directed: Light of the sun at its brightest.
    """

    towards_sun: Float[Array, "3"] | np.ndarray
    lamp_m: Float[Array, "3"] | np.ndarray
    fading_per_m2: Float[Array, ""] | np.float32
    brightness: Float[Array, ""] | np.float32
    ambient: Float[Array, ""] | np.float32
    directed: Float[Array, ""] | np.float32

    def blended(self, other: "Light", share: float) -> "Light":
        """Return this light with a share of another one."""
        mix: Any = lambda mine, theirs: np.asarray(mine + share * (theirs - mine), np.float32)
        return Light(*map(mix, self, other))


ROOM_LIGHT = Light(
    towards_sun=np.array([-0.45, 0.30, 0.84], np.float32),
    lamp_m=np.array([-0.6, 0.4, 2.6], np.float32),
    fading_per_m2=np.float32(1.0) / np.float32(4.2**2),
    brightness=np.float32(1.45),
    ambient=np.float32(0.42),
    directed=np.float32(0.58),
)
"""Light of the furnished room."""


class Hits(NamedTuple):
    """Hits of the rays of a tile.

    Attributes:
        rays: The rays.
        depth: Depth of the hit, good to a few digits.
        which: Index of the solid.
        is_box: Whether that is a box.
    """

    rays: Rays
    depth: Plane
    which: Int[Array, " p"]
    is_box: Bool[Array, " p"]


def shade(
    table: Float[Array, "n 19"],
    surfaces: UInt[Array, "s 12"],
    hits: Hits,
    world_from_cam: Float[Array, "3 4"],
    focal: Float[Array, ""],
    light: Light,
    change: Float[Array, "n 12"] | None = None,
) -> tuple[UInt[Array, " p"], Plane, Plane]:
    """Color and exact place of hits.

    Args:
        table: Row of each solid: the 12 numbers of its map from camera to unit coordinates (`raycast.Shapes`), its size
            in meters, its stem, the direction to the sun in its coordinates.
        surfaces: `texture.surface_row`s, six a solid.
        hits: Hits to shade.
        world_from_cam: Rigid transform from camera to world coordinates.
        focal: Focal length in pixels.
        light: Light of the scene.
        change: What the first 12 numbers of `table` change by over the rows of the tile; `None` for nothing.

    Returns:
        Packed color, depth, and the cosine between ray and surface normal.
    """
    planes = _gather(table, hits.which)
    rays = hits.rays
    if change is not None:
        planes = planes.at[:12].add(rays.share[None] * _gather(change, hits.which))
    size, stem, sun = (planes[12], planes[13], planes[14]), planes[15], (planes[16], planes[17], planes[18])
    origin = (planes[3], planes[7], planes[11])
    ray = _each(lambda k: planes[4 * k] * rays.x + planes[4 * k + 1] * rays.y + planes[4 * k + 2])
    point = _each(lambda k: origin[k] + hits.depth * ray[k])
    depth = hits.depth - _newton_step(point, ray, stem, hits)
    point = _each(lambda k: origin[k] + depth * ray[k])
    axis, normal = _normal(point, size, stem, hits.is_box)
    metric_ray = _each(lambda k: size[k] * ray[k])
    incidence = jnp.abs(_dot(normal, metric_ray)) / jnp.sqrt(1.0 + rays.x * rays.x + rays.y * rays.y)
    place = _each(lambda k: size[k] * point[k])
    u, v = jnp.where(axis == 0, place[1], place[0]), jnp.where(axis == 2, place[1], place[2])
    side = 6 * hits.which + 2 * axis + (_component(point, axis) > 0.0).astype(jnp.int32)
    pixels_per_m = focal * jnp.maximum(incidence, 0.05) / depth
    bright = _brightness(light, world_from_cam, hits, depth, _dot(normal, sun))
    red, green, blue = texture_color(u, v, pixels_per_m, as_surface(_gather(surfaces, side)))
    return _pack_color(bright * red, bright * green, bright * blue), depth, incidence


def _pack_color(red: Plane, green: Plane, blue: Plane) -> UInt[Array, " p"]:
    scaled = (jnp.clip(_LEVELS * channel + 0.5, 0.0, 1023.0).astype(jnp.int32) for channel in (red, green, blue))
    low, middle, high = (channel.astype(jnp.uint32) for channel in scaled)
    return low | (middle << 10) | (high << 20)


def unpack_color(packed: UInt[Array, "h w"]) -> Float[Array, "3 h w"]:
    """Red, green and blue, 0 to 1 and a little beyond."""
    channels = [((packed >> shift) & jnp.uint32(1023)).astype(jnp.float32) for shift in (0, 10, 20)]
    return jnp.stack(channels) / _LEVELS


def _gather(table: Shaped[Array, "n k"], which: Int[Array, " p"]) -> Shaped[Array, "k p"]:
    return table.at[which].get(mode="promise_in_bounds").T


def _newton_step(point: Vectors, ray: Vectors, stem: Plane, hits: Hits) -> Plane:
    """Return the excess depth of each hit: the digits of the depth that made room for the index of the solid."""
    axis = _largest(point)
    along = _component(point, axis)
    flat = (jnp.abs(along) - 1.0) * jnp.sign(along) / _component(ray, axis)
    from_axis = (point[0], point[1], point[2] - jnp.clip(point[2], -stem, stem))
    bent = 0.5 * (_dot(from_axis, from_axis) - 1.0) / jnp.minimum(_dot(from_axis, ray), -1e-6)
    limit = 1e-3 * hits.depth
    return jnp.clip(jnp.where(hits.is_box, flat, bent), -limit, limit)


def _normal(point: Vectors, size: Vectors, stem: Plane, is_box: Bool[Array, " p"]) -> tuple[Int[Array, " p"], Vectors]:
    """The axis a surface faces most, which chooses its texture, and its unit normal, outwards."""
    x, y, z = point[0] / size[0], point[1] / size[1], (point[2] - jnp.clip(point[2], -stem, stem)) / size[2]
    scale = jax.lax.rsqrt(jnp.maximum(x * x + y * y + z * z, 1e-12))
    bent = (x * scale, y * scale, z * scale)
    axis = _largest(_each(lambda k: jnp.where(is_box, point[k], bent[k])))
    flat = _each(lambda k: jnp.where(axis == k, jnp.sign(point[k]), 0.0))
    return axis, _each(lambda k: jnp.where(is_box, flat[k], bent[k]))


def _brightness(
    light: Light, world_from_cam: Float[Array, "3 4"], hits: Hits, depth: Plane, towards_sun: Plane
) -> Plane:
    """Ambient light, light from one direction that wraps round, both fading with the distance from a lamp."""
    start = world_from_cam[:, 3] - light.lamp_m
    x, y = hits.rays.x, hits.rays.y
    turned = _each(lambda k: world_from_cam[k, 0] * x + world_from_cam[k, 1] * y + world_from_cam[k, 2])
    from_lamp = _each(lambda k: start[k] + depth * turned[k])
    wrapped = light.ambient + light.directed * (0.5 + 0.5 * towards_sun)
    return light.brightness * wrapped / (1.0 + _dot(from_lamp, from_lamp) * light.fading_per_m2)


def _each(component: Callable[[int], Plane]) -> Vectors:
    return component(0), component(1), component(2)


def _dot(a: Vectors, b: Vectors) -> Plane:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _largest(vectors: Vectors) -> Int[Array, " p"]:
    """The axis along which each vector is longest."""
    x, y, z = (jnp.abs(component) for component in vectors)
    return jnp.where((x >= y) & (x >= z), 0, jnp.where(y >= z, 1, 2)).astype(jnp.int32)


def _component(vectors: Vectors, axis: Int[Array, " p"]) -> Plane:
    return jnp.where(axis == 0, vectors[0], jnp.where(axis == 1, vectors[1], vectors[2]))
