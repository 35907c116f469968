"""Pictures of a scene in JAX: tile by tile, first what each pixel shows, then its color, once.

Rays have unit depth, so that a distance along a ray is a depth along the optical axis.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, UInt

from jaxslam.datasets.synthetic.primitives import Solid
from jaxslam.datasets.synthetic.raycast import (
    TILE_HEIGHT,
    TILE_WIDTH,
    InTile,
    Plane,
    Shapes,
    compact,
    nearest_solid,
    solids_in_tiles,
    unpack,
)
from jaxslam.datasets.synthetic.shading import Hits, Light, shade
from jaxslam.datasets.synthetic.texture import N_WORDS
from jaxslam.runtime.compile_cache import FUSION_EMITTERS
from jaxslam.runtime.compiled import compiled

_CAPACITY_STEP = 64


class RenderScene(NamedTuple):
    """Every solid, `b` boxes and then `c` capsules, each kind padded to a capacity; the first box is the room.

    Attributes:
        box_size: Half extents in meters.
        capsule_size: Radii in meters.
        capsule_stem: Half lengths of the axes in units of the third radius.
        surface: Texture parameters, six surfaces a solid.
        owner: 0 for static solids, otherwise the number of the actor.
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
        solid_from_cam: Rigid transforms from camera coordinates to those of each solid.
        world_from_cam: Rigid transform from camera to world coordinates.
        intrinsics: `fx, fy, cx, cy` in pixels.
        offset: Position of each ray in its pixel, `(u, v)`, 0 for the center.
    """

    solid_from_cam: Float[Array, "n 3 4"]
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


def pack_scene(solids: list[Solid], owner: list[int], light: Light) -> tuple[RenderScene, np.ndarray]:
    """Arrange solids for rendering.

    Args:
        solids: The room first, then any boxes and capsules.
        owner: The number of the actor of each solid, 0 for none.
        light: Light of the scene.

    Returns:
        The scene, and the slot of each solid in it, `(len(solids),)`: the row of its transform in a `View`.
    """
    boxes = [i for i, solid in enumerate(solids) if solid.stem is None]
    capsules = [i for i, solid in enumerate(solids) if solid.stem is not None]
    n_boxes, n = _capacity(len(boxes)), _capacity(len(boxes)) + _capacity(len(capsules))
    slots = np.zeros(len(solids), np.int64)
    slots[boxes] = np.arange(len(boxes))
    slots[capsules] = n_boxes + np.arange(len(capsules))
    size, stem = np.ones((n, 3), np.float32), np.zeros(n, np.float32)
    surface = np.ones((n, 6, N_WORDS), np.uint32)
    owners, used = np.zeros(n, np.int32), np.zeros(n, bool)
    for slot, solid, number in zip(slots, solids, owner, strict=True):
        size[slot], stem[slot], surface[slot] = solid.size, solid.stem or 0.0, solid.surface
        owners[slot], used[slot] = number, True
    scene = RenderScene(
        jnp.asarray(size[:n_boxes]),
        jnp.asarray(size[n_boxes:]),
        jnp.asarray(stem[n_boxes:]),
        jnp.asarray(surface.reshape(-1, N_WORDS)),
        jnp.asarray(owners),
        jnp.asarray(used),
        Light(*map(jnp.asarray, light)),
    )
    return scene, slots


def _capacity(count: int) -> int:
    return _CAPACITY_STEP * -(-max(count, 1) // _CAPACITY_STEP)


@compiled(when="first use", static=("height", "width"), options=FUSION_EMITTERS)
def render(scene: RenderScene, view: CameraView, *, height: int, width: int) -> Rendering:
    """Cast one ray a pixel.

    Args:
        scene: Solids and light of the scene.
        view: From where it is seen.
        height: Rows of the image, static.
        width: Columns of the image, static.
    """
    n_boxes = scene.box_size.shape[0]
    rows, columns = -(-height // TILE_HEIGHT), -(-width // TILE_WIDTH)
    size = jnp.concatenate([scene.box_size, scene.capsule_size])
    stem = jnp.concatenate([jnp.zeros(n_boxes, scene.capsule_stem.dtype), scene.capsule_stem])
    shapes = Shapes(view.solid_from_cam / size[:, :, None], stem)
    reaches = solids_in_tiles(_corners(view, size, stem), view.intrinsics, rows, columns) & scene.used[None]
    boxes, capsules = compact(reaches[:, 1:n_boxes], 1), compact(reaches[:, n_boxes:], n_boxes)
    sun = jnp.einsum("nij,kj,k->ni", view.solid_from_cam[:, :, :3], view.world_from_cam[:, :3], scene.light.towards_sun)
    table = jnp.concatenate([shapes.unit_from_cam.reshape(-1, 12), size, stem[:, None], sun], axis=1)

    def render_tile(tile: tuple[Array, InTile, InTile]) -> tuple[Array, ...]:
        index, boxes, capsules = tile
        x, y = _rays(view, (index // columns) * TILE_HEIGHT, (index % columns) * TILE_WIDTH)
        depth, which = unpack(shapes, nearest_solid(shapes, x, y, boxes, capsules))
        hits = Hits(x, y, depth, which, which < n_boxes)
        return (
            *shade(table, scene.surface, hits, view.world_from_cam, view.intrinsics[0], scene.light),
            scene.owner[which],
        )

    planes = jax.lax.map(render_tile, (jnp.arange(rows * columns, dtype=jnp.int32), boxes, capsules))
    return Rendering(*(_untile(plane, rows, columns)[:height, :width] for plane in planes))


def _corners(view: CameraView, size: Float[Array, "n 3"], stem: Float[Array, " n"]) -> Float[Array, "3 8 n"]:
    """The corners of the bounding boxes of all solids in camera coordinates."""
    signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], np.float32)
    bounds = size.at[:, 2].multiply(1.0 + stem)
    local = signs[:, None, :] * bounds[None] - view.solid_from_cam[None, :, :, 3]
    return jnp.einsum("nij,kni->jkn", view.solid_from_cam[:, :, :3], local)


def _rays(view: CameraView, row: Int[Array, ""], column: Int[Array, ""]) -> tuple[Plane, Plane]:
    """Rays `(x, y, 1)` through the pixels of one tile."""
    fx, fy, cx, cy = view.intrinsics
    v, u = np.divmod(np.arange(TILE_HEIGHT * TILE_WIDTH, dtype=np.int32), np.int32(TILE_WIDTH))
    x = ((u + column).astype(jnp.float32) + view.offset[0] - cx) / fx
    y = ((v + row).astype(jnp.float32) + view.offset[1] - cy) / fy
    return x, y


def _untile(tiles: Array, rows: int, columns: int) -> Array:
    """`(rows * columns, p)` to `(rows * tile height, columns * tile width)`."""
    blocks = tiles.reshape(rows, columns, TILE_HEIGHT, TILE_WIDTH)
    return blocks.transpose(0, 2, 1, 3).reshape(rows * TILE_HEIGHT, columns * TILE_WIDTH)
