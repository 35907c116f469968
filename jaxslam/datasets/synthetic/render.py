"""Pictures of a scene in JAX: tile by tile, first what each pixel shows, then its color, once.

Rays have unit depth, so that a distance along a ray is a depth along the optical axis.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxslam_kernels.program_parts import apart
from jaxtyping import Array, Bool, Float, Int, UInt

from jaxslam.datasets.synthetic.culling import (
    Candidates,
    Tiling,
    list_candidates,
    rows_of_solids,
    solids_in_tiles,
)
from jaxslam.datasets.synthetic.primitives import Solid
from jaxslam.datasets.synthetic.raycast import Rays, Shapes, nearest_solid, unpack
from jaxslam.datasets.synthetic.shading import Hits, Light, shade
from jaxslam.datasets.synthetic.texture import N_WORDS
from jaxslam.runtime.compiled import compiled
from jaxslam.runtime.compiler_options import FUSION_EMITTERS, SINGLE_THREAD

BACKDROP = -1
"""Owner of the solid behind everything, such as the sky."""


class RenderScene(NamedTuple):
    """Every solid, `b` boxes and then `c` capsules, each kind padded to a capacity; the first box is the room.

    Attributes:
        box_size: Half extents in meters.
        capsule_size: Radii in meters.
        capsule_stem: Half lengths of the axes in units of the third radius.
        surface: Texture parameters, six surfaces a solid.
        owner: 0 for static solids, `BACKDROP` for what is behind everything, otherwise the number of the actor.
        used: Whether the entry holds a solid.
        light: Light of the scene.
    """

    box_size: Float[Array, "b 3"]
    capsule_size: Float[Array, "c 3"]
    capsule_stem: Float[Array, " c"]
    surface: UInt[Array, "s 12"]
    owner: Int[Array, " n"]
    used: Bool[Array, " n"]
    light: Light


class CameraView(NamedTuple):
    """One camera pose and where the solids are at that moment.

    Attributes:
        solid_from_cam: Rigid transforms from camera coordinates to those of each solid. With a rolling shutter, those
            at the times of the first row of each row of tiles, and of one row of tiles more.
        world_from_cam: Rigid transform from camera to world coordinates; with a rolling shutter, that of the middle.
        intrinsics: `fx, fy, cx, cy` in pixels.
        offset: Position of each ray in its pixel, `(u, v)`, 0 for the center.
    """

    solid_from_cam: Float[Array, "n 3 4"] | Float[Array, "rows n 3 4"]
    world_from_cam: Float[Array, "3 4"]
    intrinsics: Float[Array, " 4"]
    offset: Float[Array, " 2"]


class Rendering(NamedTuple):
    """Image and depth before any sensor model, as planes of the picture, or of rows of its tiles.

    Attributes:
        color: Packed color; see `shading.unpack_color`.
        depth_m: Depth along the optical axis; every ray hits something.
        incidence: Cosine of the angle between the ray and the surface normal.
        owner: 0 on static things, otherwise the number of the actor.
    """

    color: UInt[Array, "*plane"]
    depth_m: Float[Array, "*plane"]
    incidence: Float[Array, "*plane"]
    owner: Int[Array, "*plane"]


class PackedSolids(NamedTuple):
    """Solids as rows of arrays, in the order given.

    Attributes:
        size: Half extents of boxes, radii of capsules, `(n, 3)` meters.
        stem: Half lengths of the axes of capsules in units of the third radius, `(n,)`; 0 for boxes.
        surface: Texture parameters of six sides, `(n, 6, N_WORDS)`.
        owner: Number of the actor of each, `(n,)`; 0 for none.
        is_box: Whether it is a box, `(n,)`.
    """

    size: np.ndarray
    stem: np.ndarray
    surface: np.ndarray
    owner: np.ndarray
    is_box: np.ndarray


def pack_solids(solids: Sequence[Solid], owner: Sequence[int]) -> PackedSolids:
    """Pack solids, with the number of the actor of each, 0 for none."""
    return PackedSolids(
        np.array([solid.size for solid in solids], np.float32),
        np.array([solid.stem or 0.0 for solid in solids], np.float32),
        np.array([solid.surface for solid in solids], np.uint32),
        np.array(owner, np.int32),
        np.array([solid.stem is None for solid in solids]),
    )


def arrange_scene(
    packed: PackedSolids, chosen: np.ndarray, light: Light, capacity: Callable[[int], int]
) -> tuple[RenderScene, np.ndarray]:
    """Arrange solids for rendering.

    Args:
        packed: The solids.
        chosen: Indices of those to render; the first one is the box around everything.
        light: Light of the scene.
        capacity: Number of entries for a number of boxes, or of capsules: each new one is compiled.

    Returns:
        The scene, and the slot of each chosen solid in it: the row of its transform in a `CameraView`.
    """
    is_box = packed.is_box[chosen]
    num_boxes = int(is_box.sum())
    n_boxes = capacity(num_boxes)
    n = n_boxes + capacity(len(chosen) - num_boxes)
    slots = np.where(is_box, np.cumsum(is_box) - 1, n_boxes + np.cumsum(~is_box) - 1)
    size, stem = np.ones((n, 3), np.float32), np.zeros(n, np.float32)
    surface = np.ones((n, 6, N_WORDS), np.uint32)
    owners, used = np.zeros(n, np.int32), np.zeros(n, bool)
    size[slots], stem[slots], surface[slots] = packed.size[chosen], packed.stem[chosen], packed.surface[chosen]
    owners[slots], used[slots] = packed.owner[chosen], True
    surfaces = surface.reshape(-1, N_WORDS)
    arrays: Any = (size[:n_boxes], size[n_boxes:], stem[n_boxes:], surfaces, owners, used, light)
    return jax.device_put(RenderScene(*arrays)), slots


def find_candidates(
    scene: RenderScene, solid_from_cam: np.ndarray, intrinsics: np.ndarray, height: int, width: int
) -> Candidates:
    """List what the tiles of a picture have to look at, over all moments of its exposure.

    Args:
        scene: Solids of the scene.
        solid_from_cam: `CameraView.solid_from_cam` of each moment, `(t, n, 3, 4)` or `(t, rows, n, 3, 4)`.
        intrinsics: `fx, fy, cx, cy` in pixels.
        height: Rows of the image.
        width: Columns of the image.
    """
    tiling = Tiling.of(height, width)
    reaches, rows = (np.asarray(each) for each in _reach(scene, solid_from_cam, intrinsics, tiling=tiling))
    return list_candidates(reaches, rows, len(scene.box_size), tiling)


@compiled(when="first use", static=("tiling",))
def _reach(
    scene: RenderScene, solid_from_cam: Array, intrinsics: Float[Array, " 4"], *, tiling: Tiling
) -> tuple[Bool[Array, "tiles n"], Int[Array, "r 2 n"]]:
    """Tell which solids but the first may reach into which tiles, and into which rows of the picture."""
    size, stem = _sizes_and_stems(scene)
    if solid_from_cam.ndim == 4:
        over_time = solid_from_cam[None]
    else:
        # Over the time of a row of tiles, a corner is between where it is at the beginning and at the end.
        by_row = jnp.moveaxis(solid_from_cam, 1, 0)
        over_time = jnp.concatenate([by_row[:-1], by_row[1:]], axis=1)
    corners = jax.vmap(lambda moments: _corners(moments, size, stem))(over_time)
    reaches = solids_in_tiles(corners, intrinsics, tiling) & scene.used[None]
    return reaches.at[:, 0].set(False), jax.vmap(lambda each: rows_of_solids(each, intrinsics))(corners)


def _sizes_and_stems(scene: RenderScene) -> tuple[Float[Array, "n 3"], Float[Array, " n"]]:
    """Sizes of boxes and capsules, and stems, 0 for boxes."""
    size = jnp.concatenate([scene.box_size, scene.capsule_size])
    return size, jnp.concatenate([jnp.zeros(len(scene.box_size), scene.capsule_stem.dtype), scene.capsule_stem])


@compiled(when="first use", static=("height", "width", "rows"), options=FUSION_EMITTERS | SINGLE_THREAD)
def render(
    scene: RenderScene,
    view: CameraView,
    candidates: Candidates,
    first: int,
    *,
    rows: int,
    height: int,
    width: int,
) -> Rendering:
    """Cast one ray a pixel; the result is in tiles, for `untiled`.

    Args:
        scene: Solids and light of the scene.
        view: From where it is seen.
        candidates: What the tiles have to look at, from `find_candidates`.
        first: First row of tiles to render.
        rows: Number of rows of tiles to render, static.
        height: Rows of the image, static.
        width: Columns of the image, static.
    """
    n_boxes, tiling = scene.box_size.shape[0], Tiling.of(height, width)
    rolls = view.solid_from_cam.ndim == 4

    def prepared() -> tuple[Array, Array, Array, tuple[Array, Array]]:
        unit_from_cam, stem, own = _tables(scene, view, tiling.rows // 2 if rolls else None)
        table = own if rolls else jnp.concatenate([unit_from_cam.reshape(-1, 12), own], axis=1)
        tiles = (jnp.arange(tiling.rows * tiling.columns, dtype=jnp.int32), candidates.begins)
        start, count = first * tiling.columns, rows * tiling.columns
        return unit_from_cam, stem, table, jax.tree.map(lambda x: jax.lax.dynamic_slice_in_dim(x, start, count), tiles)

    # In one part, so that XLA leaves the program in the thread that calls it: see `compiler_options.SINGLE_THREAD`.
    unit_from_cam, stem, table, tiles = apart(prepared)

    def shapes_and_looks(row: Array) -> tuple[Shapes, Array, Array | None]:
        """Shapes of the solids as a row of tiles sees them, their rows of the table, and what those change by."""
        if not rolls:
            return Shapes(unit_from_cam, stem), table, None
        above = unit_from_cam[row]
        change = unit_from_cam[row + 1] - above
        looks = jnp.concatenate([above.reshape(-1, 12), table], axis=1)
        return Shapes(above, stem, change), looks, change.reshape(-1, 12)

    def render_tile(tile: tuple[Array, Array]) -> tuple[Array, ...]:
        index, begins = tile
        row, column = index // tiling.columns, index % tiling.columns
        rays = _rays(view, row, column, tiling)
        shapes, looks, changes = shapes_and_looks(row)
        nearest = nearest_solid(shapes, rays, candidates._replace(begins=begins), tiling)
        depth, which = unpack(shapes, nearest)
        hits = Hits(rays, depth, which, which < n_boxes)
        return (
            *shade(looks, scene.surface, hits, view.world_from_cam, view.intrinsics[0], scene.light, changes),
            scene.owner[which],
        )

    planes = jax.lax.map(render_tile, tiles)
    return Rendering(*(plane.reshape(rows, tiling.columns, tiling.height, tiling.width) for plane in planes))


def _tables(scene: RenderScene, view: CameraView, middle: int | None) -> tuple[Array, Array, Array]:
    """Maps from camera to unit coordinates, stems, and what else the colors of solids need: size, stem, sun.

    Args:
        scene: Solids and light of the scene.
        view: From where it is seen.
        middle: With a rolling shutter, the row of tiles whose time the sun stands for; `None` without.
    """
    size, stem = _sizes_and_stems(scene)
    unit_from_cam = view.solid_from_cam / (size[:, :, None] if middle is None else size[None, :, :, None])
    turned = (view.solid_from_cam if middle is None else view.solid_from_cam[middle])[:, :, :3]
    sun = jnp.einsum("nij,kj,k->ni", turned, view.world_from_cam[:, :3], scene.light.towards_sun)
    # Nothing turns the sky towards the sun.
    sun = jnp.where((scene.owner == BACKDROP)[:, None], 0.0, sun)
    return unit_from_cam, stem, jnp.concatenate([size, stem[:, None], sun], axis=1)


def untiled(parts: Sequence[np.ndarray | Array], height: int, width: int) -> np.ndarray:
    """Put a plane of `render` together, `(height, width)`; its parts are below each other."""
    tiling = Tiling.of(height, width)
    whole, rest = divmod(width, tiling.width)
    plane = np.empty((height, width), parts[0].dtype)
    row_of_tiles = (tiles for part in parts for tiles in np.asarray(part))
    for top, tiles in zip(range(0, height, tiling.height), row_of_tiles, strict=False):
        band = plane[top : top + tiling.height]
        across = np.swapaxes(tiles[:, : len(band)], 0, 1)
        band[:, : width - rest].reshape(len(band), whole, tiling.width)[:] = across[:, :whole]
        band[:, width - rest :] = across[:, -1, :rest]
    return plane


def _corners(
    solid_from_cam: Float[Array, "t n 3 4"], size: Float[Array, "n 3"], stem: Float[Array, " n"]
) -> Float[Array, "3 t*8 n"]:
    """The corners of the bounding boxes of all solids in camera coordinates, at several moments."""
    signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], np.float32)
    bounds = size.at[:, 2].multiply(1.0 + stem)
    local = (signs[:, None, :] * bounds[None])[None] - solid_from_cam[:, None, :, :, 3]
    corners = jnp.einsum("tnij,tkni->jtkn", solid_from_cam[..., :3], local)
    return corners.reshape(3, -1, len(size))


def _rays(view: CameraView, row: Int[Array, ""], column: Int[Array, ""], tiling: Tiling) -> Rays:
    """Rays through the pixels of one tile."""
    fx, fy, cx, cy = view.intrinsics
    v, u = np.divmod(np.arange(tiling.height * tiling.width, dtype=np.int32), np.int32(tiling.width))
    x = ((u + column * tiling.width).astype(jnp.float32) + view.offset[0] - cx) / fx
    y = ((v + row * tiling.height).astype(jnp.float32) + view.offset[1] - cy) / fy
    return Rays(x, y, jnp.asarray(v / np.float32(tiling.height)))
