"""Pictures of a scene in JAX: tile by tile, first what each pixel shows, then its color, once.

Rays have unit depth, so that a distance along a ray is a depth along the optical axis.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, UInt

from jaxslam.datasets.synthetic.primitives import Solid
from jaxslam.datasets.synthetic.raycast import (
    TILE_HEIGHT,
    TILE_WIDTH,
    InTile,
    Rays,
    Shapes,
    compact,
    nearest_solid,
    rows_of_solids,
    solids_in_tiles,
    unpack,
)
from jaxslam.datasets.synthetic.shading import Hits, Light, shade
from jaxslam.datasets.synthetic.texture import N_WORDS
from jaxslam.runtime.compiled import compiled
from jaxslam.runtime.compiler_options import FUSION_EMITTERS

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
    """Image and depth before any sensor model.

    Attributes:
        color: Packed color; see `shading.unpack_color`.
        depth_m: Depth along the optical axis; every ray hits something.
        incidence: Cosine of the angle between the ray and the surface normal.
        owner: 0 on static things, otherwise the number of the actor.
    """

    color: UInt[Array, "h w"]
    depth_m: Float[Array, "h w"]
    incidence: Float[Array, "h w"]
    owner: Int[Array, "h w"]


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


@compiled(when="first use", static=("height", "width", "rows"), options=FUSION_EMITTERS)
def render(
    scene: RenderScene, view: CameraView, first: int = 0, *, height: int, width: int, rows: int | None = None
) -> Rendering:
    """Cast one ray a pixel.

    Args:
        scene: Solids and light of the scene.
        view: From where it is seen.
        first: First row of tiles to render, if not all.
        height: Rows of the image, static.
        width: Columns of the image, static.
        rows: Rows of tiles to render, static; `None` for all.
    """
    n_boxes = scene.box_size.shape[0]
    all_rows, columns = tile_rows(height), -(-width // TILE_WIDTH)
    size = jnp.concatenate([scene.box_size, scene.capsule_size])
    stem = jnp.concatenate([jnp.zeros(n_boxes, scene.capsule_stem.dtype), scene.capsule_stem])
    rolls = view.solid_from_cam.ndim == 4
    unit_from_cam = view.solid_from_cam / (size[None, :, :, None] if rolls else size[:, :, None])
    reaches, rows_of = _tiles_and_rows(view, size, stem, all_rows, columns)
    reaches &= scene.used[None]
    boxes, capsules = compact(reaches[:, 1:n_boxes], 1), compact(reaches[:, n_boxes:], n_boxes)
    turned = (view.solid_from_cam[all_rows // 2] if rolls else view.solid_from_cam)[:, :, :3]
    sun = jnp.einsum("nij,kj,k->ni", turned, view.world_from_cam[:, :3], scene.light.towards_sun)
    # Nothing turns the sky towards the sun.
    sun = jnp.where((scene.owner == BACKDROP)[:, None], 0.0, sun)
    own = jnp.concatenate([size, stem[:, None], sun], axis=1)
    first_pose = unit_from_cam[0] if rolls else unit_from_cam
    table = jnp.concatenate([first_pose.reshape(-1, 12), own], axis=1)

    def shapes_and_looks(row: Array) -> tuple[Shapes, Array, Array | None]:
        """Shapes of the solids as a row of tiles sees them, their rows of the table, and what those change by."""
        if not rolls:
            return Shapes(unit_from_cam, stem, rows_of), table, None
        above = unit_from_cam[row]
        change = unit_from_cam[row + 1] - above
        looks = jnp.concatenate([above.reshape(-1, 12), own], axis=1)
        return Shapes(above, stem, rows_of[row], change), looks, change.reshape(-1, 12)

    def render_tile(tile: tuple[Array, InTile, InTile]) -> tuple[Array, ...]:
        index, boxes, capsules = tile
        top = (index // columns) * TILE_HEIGHT
        rays = _rays(view, top, (index % columns) * TILE_WIDTH)
        shapes, looks, changes = shapes_and_looks(index // columns)
        depth, which = unpack(shapes, nearest_solid(shapes, rays, boxes, capsules, top))
        hits = Hits(rays, depth, which, which < n_boxes)
        return (
            *shade(looks, scene.surface, hits, view.world_from_cam, view.intrinsics[0], scene.light, changes),
            scene.owner[which],
        )

    tiles = (jnp.arange(all_rows * columns, dtype=jnp.int32), boxes, capsules)
    if rows is None:
        rows = all_rows
    else:
        tiles = jax.tree.map(lambda each: jax.lax.dynamic_slice_in_dim(each, first * columns, rows * columns), tiles)
    planes = jax.lax.map(render_tile, tiles)
    return Rendering(*(_untile(plane, rows, columns)[:height, :width] for plane in planes))


def tile_rows(height: int) -> int:
    """Return the number of rows of tiles of an image of `height` rows."""
    return -(-height // TILE_HEIGHT)


def _tiles_and_rows(
    view: CameraView, size: Float[Array, "n 3"], stem: Float[Array, " n"], rows: int, columns: int
) -> tuple[Bool[Array, "tiles n"], Int[Array, "*rows 2 n"]]:
    """Tell which solids may reach into which tiles, and into which rows of the picture at the time of each."""
    if view.solid_from_cam.ndim == 3:
        corners = _corners(view.solid_from_cam, size, stem)
        return solids_in_tiles(corners, view.intrinsics, rows, columns), rows_of_solids(corners, view.intrinsics)
    corners = jax.vmap(lambda solid_from_cam: _corners(solid_from_cam, size, stem))(view.solid_from_cam)
    # Over the time of a row of tiles, a corner is between where it is at the beginning and at the end.
    over_time = jnp.concatenate([corners[:-1], corners[1:]], axis=2)
    reaches = [
        solids_in_tiles(over_time[row], view.intrinsics, rows, columns).reshape(rows, columns, -1)[row]
        for row in range(rows)
    ]
    return jnp.concatenate(reaches), jax.vmap(lambda each: rows_of_solids(each, view.intrinsics))(over_time)


def _corners(
    solid_from_cam: Float[Array, "n 3 4"], size: Float[Array, "n 3"], stem: Float[Array, " n"]
) -> Float[Array, "3 8 n"]:
    """The corners of the bounding boxes of all solids in camera coordinates."""
    signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], np.float32)
    bounds = size.at[:, 2].multiply(1.0 + stem)
    local = signs[:, None, :] * bounds[None] - solid_from_cam[None, :, :, 3]
    return jnp.einsum("nij,kni->jkn", solid_from_cam[:, :, :3], local)


def _rays(view: CameraView, row: Int[Array, ""], column: Int[Array, ""]) -> Rays:
    """Rays through the pixels of one tile."""
    fx, fy, cx, cy = view.intrinsics
    v, u = np.divmod(np.arange(TILE_HEIGHT * TILE_WIDTH, dtype=np.int32), np.int32(TILE_WIDTH))
    x = ((u + column).astype(jnp.float32) + view.offset[0] - cx) / fx
    y = ((v + row).astype(jnp.float32) + view.offset[1] - cy) / fy
    return Rays(x, y, jnp.asarray(v / np.float32(TILE_HEIGHT)))


def _untile(tiles: Array, rows: int, columns: int) -> Array:
    """`(rows * columns, p)` to `(rows * tile height, columns * tile width)`."""
    blocks = tiles.reshape(rows, columns, TILE_HEIGHT, TILE_WIDTH)
    return blocks.transpose(0, 2, 1, 3).reshape(rows * TILE_HEIGHT, columns * TILE_WIDTH)
