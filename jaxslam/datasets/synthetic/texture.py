"""Procedural textures: noise, bricks or planks, and scattered patches, all prefiltered by the pixel's footprint.

A texture is a function of meters on the surface, so that it is the same from everywhere. Each of its scales fades
out where it becomes finer than a pixel sees, because what shimmers in the distance cannot be tracked honestly.

Three numbers make a color, from a palette of four a surface: `blend` goes from the first color to the second,
`mark` from there to the third (below zero) or the fourth (above), `joint` darkens.
"""

from typing import NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, UInt

from jaxslam.datasets.synthetic.raycast import Plane

Rgb: TypeAlias = tuple[float, float, float]
Bits: TypeAlias = UInt[Array, " p"]

N_OCTAVES = 7
N_PATCH_LAYERS = 3
_PERSISTENCE = 0.8
_FINER_PATCHES = 3.7
_ACROSS, _ALONG = np.uint32(0x9E3779B1), np.uint32(0x85EBCA77)


class Material(NamedTuple):
    """Texture of a surface; colors are RGB from 0 to 1.

    Attributes:
        color: Color where the noise is low.
        second: Color where the noise is high.
        dark: Color of one half of the bricks and patches.
        bright: Color of the other half.
        noise_per_m: Cells a meter of the coarsest octave; each of the `N_OCTAVES` next ones has twice as many.
        stretch: Factor by which the noise is longer along the second axis of the surface.
        noise: Strength of the noise, 0 to 1.
        cell_m: Width and height of bricks, tiles or planks.
        joint_m: Width of the joints between them; 0 for none.
        cell_contrast: Contrast between bricks, 0 to 1.
        patch_m: Cell of the coarsest layer of patches; each of the `N_PATCH_LAYERS` next ones is about a quarter.
        patch_density: Probability that a cell holds a patch.
        patch_contrast: Contrast of a patch to the surface that it covers, 0 to 1.
    """

    color: Rgb
    second: Rgb
    dark: Rgb = (0.15, 0.13, 0.12)
    bright: Rgb = (0.92, 0.90, 0.85)
    noise_per_m: float = 2.0
    stretch: float = 1.0
    noise: float = 0.5
    cell_m: tuple[float, float] = (1.0, 1.0)
    joint_m: float = 0.0
    cell_contrast: float = 0.0
    patch_m: float = 0.5
    patch_density: float = 0.0
    patch_contrast: float = 0.8


class Surface(NamedTuple):
    """The texture of what each pixel shows, one plane a number: a `Material` made ready to do without divisions."""

    color: tuple[Plane, Plane, Plane]
    second: tuple[Plane, Plane, Plane]
    dark: tuple[Plane, Plane, Plane]
    bright: tuple[Plane, Plane, Plane]
    noise: Plane
    noise_per_m: tuple[Plane, Plane]
    cells_per_m: tuple[Plane, Plane]
    cell_m: tuple[Plane, Plane]
    joint_m: Plane
    cell_contrast: Plane
    patches_per_m: Plane
    patch_m: Plane
    cells_per_patch: Plane
    patch_contrast: Plane
    seed: Bits


N_WORDS = 12
"""Words in a packed surface."""


def surface_row(material: Material, seed: int) -> np.ndarray:
    """A surface packed into `(N_WORDS,)` uint32: four colors of three bytes, fourteen bfloat16 in pairs, a seed.

    What is fetched for every pixel is worth packing; a texture does not need more digits.
    """
    colors = np.round(255.0 * np.clip(np.array(material[:4]), 0.0, 1.0)).astype(np.uint32)
    numbers = [
        material.noise,
        material.noise_per_m,
        material.noise_per_m / material.stretch,
        *(1.0 / size for size in material.cell_m),
        *material.cell_m,
        material.joint_m,
        material.cell_contrast,
        1.0 / material.patch_m,
        material.patch_m,
        1.0 / max(material.patch_density, 1e-9),
        material.patch_contrast,
        0.0,
    ]
    halves = (np.array(numbers, np.float32).view(np.uint32) + 0x8000) >> 16
    packed_colors = colors @ np.array([1, 1 << 8, 1 << 16], np.uint32)
    return np.concatenate([packed_colors, halves[::2] << 16 | halves[1::2], [seed]]).astype(np.uint32)


_POWERS_OF_LENGTH = np.array([0, -1, -1, -1, -1, 1, 1, 1, 0, -1, 1, 0, 0, 0], np.float32)
"""How the numbers of a packed surface, in order, grow with its lengths."""


def scaled_surface(rows: np.ndarray, factor: float) -> np.ndarray:
    """The same pattern with all its lengths times a factor; `rows` are `surface_row`s, `(..., N_WORDS)` uint32."""
    scaled = rows.copy()
    pairs = rows[..., 4:11]
    halves = np.stack([pairs & np.uint32(0xFFFF0000), pairs << np.uint32(16)], axis=-1).view(np.float32)
    numbers = halves.reshape(*rows.shape[:-1], 14) * np.float32(factor) ** _POWERS_OF_LENGTH
    rounded = (numbers.astype(np.float32).view(np.uint32) + np.uint32(0x8000)) >> np.uint32(16)
    scaled[..., 4:11] = rounded[..., ::2] << np.uint32(16) | rounded[..., 1::2]
    return scaled


def as_surface(words: UInt[Array, "12 p"]) -> Surface:
    """Unpack the `surface_row` of each pixel."""

    def rgb(word: Bits) -> tuple[Plane, Plane, Plane]:
        red, green, blue = ((word >> shift) & jnp.uint32(255) for shift in (0, 8, 16))
        return _scaled(red, 255), _scaled(green, 255), _scaled(blue, 255)

    def number(index: int) -> Plane:
        word = words[4 + index // 2]
        half = word << 16 if index % 2 else word & jnp.uint32(0xFFFF0000)
        return jax.lax.bitcast_convert_type(half, jnp.float32)

    return Surface(
        *(rgb(words[0]), rgb(words[1]), rgb(words[2]), rgb(words[3])),
        noise=number(0),
        noise_per_m=(number(1), number(2)),
        cells_per_m=(number(3), number(4)),
        cell_m=(number(5), number(6)),
        joint_m=number(7),
        cell_contrast=number(8),
        patches_per_m=number(9),
        patch_m=number(10),
        cells_per_patch=number(11),
        patch_contrast=number(12),
        seed=words[11],
    )


def texture_color(u: Plane, v: Plane, pixels_per_m: Plane, surface: Surface) -> tuple[Plane, Plane, Plane]:
    """Color of points on textured surfaces.

    Args:
        u: Place along the first axis of the surface in meters.
        v: Place along the second.
        pixels_per_m: Pixels that a meter of the surface takes in the image, where it is foreshortened most.
        surface: The texture of each point.

    Returns:
        Planes of red, green and blue, 0 to 1.
    """
    pixels_per_m = jnp.minimum(pixels_per_m, 1e4)
    footprint = 1.0 / pixels_per_m
    seed = surface.seed * _ACROSS
    blend = jnp.clip(0.5 + surface.noise * _fractal_noise(u, v, footprint, surface, seed), 0.0, 1.0)
    cell, joint = _cells(u, v, pixels_per_m, surface, seed)
    mark = jnp.clip(_patches(u, v, pixels_per_m, footprint, surface, seed) + cell, -1.0, 1.0)
    to_dark, to_bright, light = jnp.maximum(-mark, 0.0), jnp.maximum(mark, 0.0), 1.0 - 0.6 * joint

    def mix(color: Plane, second: Plane, dark: Plane, bright: Plane) -> Plane:
        base = color + (second - color) * blend
        return (base + (dark - base) * to_dark + (bright - base) * to_bright) * light

    red, green, blue = map(mix, surface.color, surface.second, surface.dark, surface.bright)
    return red, green, blue


def _fractal_noise(u: Plane, v: Plane, footprint: Plane, surface: Surface, seed: Bits) -> Plane:
    """Value noise summed over octaves, about -1 to 1."""
    total = jnp.zeros_like(u)
    for octave in range(N_OCTAVES):
        across, along = (2.0**octave * per_m for per_m in surface.noise_per_m)
        weight = _PERSISTENCE**octave * _fade(footprint * across)
        total = total + weight * _value_noise(u * across, v * along, seed + jnp.uint32(octave))
    return total


def _value_noise(u: Plane, v: Plane, seed: Bits) -> Plane:
    """Random values on the integer lattice, -1 to 1, interpolated smoothly."""
    column, row = jnp.floor(u), jnp.floor(v)
    a, b = u - column, v - row
    a, b = a * a * (3.0 - 2.0 * a), b * b * (3.0 - 2.0 * b)
    left, below = _lattice(column) * _ACROSS, _lattice(row) * _ALONG + seed
    right, above = left + _ACROSS, below + _ALONG
    near = _unit(_mix(left ^ below)) * (1.0 - a) + _unit(_mix(right ^ below)) * a
    far = _unit(_mix(left ^ above)) * (1.0 - a) + _unit(_mix(right ^ above)) * a
    return 2.0 * (near * (1.0 - b) + far * b) - 1.0


def _cells(u: Plane, v: Plane, pixels_per_m: Plane, surface: Surface, seed: Bits) -> tuple[Plane, Plane]:
    """Bricks in running bond: the mark of each, -1 to 1, and how much of the pixel is joint, 0 to 1."""
    y = v * surface.cells_per_m[1]
    row = jnp.floor(y)
    x = u * surface.cells_per_m[0] + 0.5 * (row - 2.0 * jnp.floor(0.5 * row))
    column = jnp.floor(x)
    to_side = (0.5 - jnp.abs(x - column - 0.5)) * surface.cell_m[0]
    to_bed = (0.5 - jnp.abs(y - row - 0.5)) * surface.cell_m[1]
    inside = (0.5 * surface.joint_m - jnp.minimum(to_side, to_bed)) * pixels_per_m
    joint = jnp.clip(inside + 0.5, 0.0, 1.0) * jnp.minimum(surface.joint_m * pixels_per_m, 1.0)
    return surface.cell_contrast * (2.0 * _unit(_hash(column, row, seed)) - 1.0), joint


def _patches(u: Plane, v: Plane, pixels_per_m: Plane, footprint: Plane, surface: Surface, seed: Bits) -> Plane:
    """Marks, -1 to 1, of random rectangles on a few scales, at most one in each cell of a layer."""
    total = jnp.zeros_like(u)
    for layer in range(N_PATCH_LAYERS):
        finer = _FINER_PATCHES**layer
        per_m, pixels = finer * surface.patches_per_m, pixels_per_m * surface.patch_m * (1.0 / finer)
        x, y = u * per_m, v * per_m
        column, row = jnp.floor(x), jnp.floor(y)
        shape = _hash(column, row, seed + jnp.uint32(101 + layer))
        sides = jnp.minimum(_inside(x - column, shape, 0), _inside(y - row, shape, 10))
        cover = jnp.clip(sides * pixels + 0.5, 0.0, 1.0) * _fade(footprint * per_m)
        random = _unit(shape * jnp.uint32(0x2C1B3C6D)) * surface.cells_per_patch
        total = total + cover * jnp.where(random < 1.0, 2.0 * random - 1.0, 0.0)
    return surface.patch_contrast * total


def _inside(x: Plane, bits: Bits, shift: int) -> Plane:
    """Distance from the nearer end of a random part of the unit interval, positive within it."""
    first, last = _five_bits(bits, shift), _five_bits(bits, shift + 5)
    return jnp.minimum(x - 0.02 - 0.4 * first, 0.98 - 0.4 * last - x)


def _fade(cells_per_pixel: Plane) -> Plane:
    """1 for cells wider than four pixels, 0 for cells narrower than two."""
    return jnp.clip(2.0 - 4.0 * cells_per_pixel, 0.0, 1.0)


def _lattice(x: Plane) -> Bits:
    return jax.lax.bitcast_convert_type(x.astype(jnp.int32), jnp.uint32)


def _hash(column: Plane, row: Plane, seed: Bits) -> Bits:
    """Random bits for each lattice point."""
    return _mix(_lattice(column) * _ACROSS ^ (_lattice(row) * _ALONG + seed))


def _mix(bits: Bits) -> Bits:
    """Spread differences over all bits, the highest best (one round of C. Wellons' `lowbias32`)."""
    bits = (bits ^ (bits >> 16)) * jnp.uint32(0x7FEB352D)
    return bits ^ (bits >> 15)


def _unit(bits: Bits) -> Plane:
    return _scaled(bits >> 8, 16777216)


def _five_bits(bits: Bits, shift: int) -> Plane:
    return _scaled((bits >> shift) & jnp.uint32(31), 31)


def _scaled(bits: Bits, largest: int) -> Plane:
    return bits.astype(jnp.int32).astype(jnp.float32) * (1.0 / largest)
