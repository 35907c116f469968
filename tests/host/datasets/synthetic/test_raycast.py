"""Rays against solids: the rows in which a solid is looked for."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxslam.datasets.synthetic.raycast import (
    TILE_HEIGHT,
    TILE_WIDTH,
    InTile,
    Rays,
    Shapes,
    compact,
    nearest_solid,
    rows_of_solids,
)

INTRINSICS = np.array([300.0, 300.0, 319.5, 239.5], np.float32)
NUM_BOXES, NUM_CAPSULES = 60, 40


def scattered(seed: int) -> tuple[Shapes, np.ndarray]:
    """Solids before, beside and behind the camera in a large box, and their corners in camera coordinates."""
    rng, n = np.random.default_rng(seed), NUM_BOXES + NUM_CAPSULES
    rotation = Rotation.random(n, rng=rng).as_matrix()
    center = rng.uniform([-10, -6, -3], [10, 6, 30], (n, 3))
    size = 10.0 ** rng.uniform(-1.5, 0.3, (n, 3))
    size[NUM_BOXES:] = size[NUM_BOXES:, :1]
    rotation[0], center[0], size[0] = np.eye(3), 0.0, 100.0
    stem = np.where(np.arange(n) < NUM_BOXES, 0.0, rng.uniform(0.0, 4.0, n))
    solid_from_cam = np.concatenate([rotation, -(rotation @ center[:, :, None])], axis=2)
    signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    bounds = size * np.stack([np.ones(n), np.ones(n), 1.0 + stem], axis=1)
    corners = np.einsum("nji,knj->ikn", rotation, signs[:, None] * bounds) + center.T[:, None]
    unit_from_cam = (solid_from_cam / size[:, :, None]).astype(np.float32)
    rows = rows_of_solids(jnp.asarray(corners, jnp.float32), jnp.asarray(INTRINSICS))
    return Shapes(jnp.asarray(unit_from_cam), jnp.asarray(stem, jnp.float32), rows), corners


def rays_of_tile(top: int, left: int) -> Rays:
    v, u = np.divmod(np.arange(TILE_HEIGHT * TILE_WIDTH), TILE_WIDTH)
    x, y = (u + left - INTRINSICS[2]) / INTRINSICS[0], (v + top - INTRINSICS[3]) / INTRINSICS[1]
    return Rays(*(jnp.asarray(each, jnp.float32) for each in (x, y, v / TILE_HEIGHT)))


def every(first: int, count: int) -> InTile:
    return InTile(jnp.arange(first, first + count, dtype=jnp.int32), jnp.int32(count))


@pytest.mark.parametrize("seed", range(3))
def test_no_ray_meets_a_solid_outside_its_rows(seed):
    shapes, corners = scattered(seed)
    anywhere = jnp.broadcast_to(jnp.array([[-1_000_000], [1_000_000]], jnp.int32), shapes.rows.shape)
    cast = jax.jit(nearest_solid)
    boxes, capsules = every(1, NUM_BOXES - 1), every(NUM_BOXES, NUM_CAPSULES)
    for top in range(0, 480, TILE_HEIGHT):
        rays, first = rays_of_tile(top, 280), jnp.int32(top)
        np.testing.assert_array_equal(
            cast(shapes, rays, boxes, capsules, first),
            cast(shapes._replace(rows=anywhere), rays, boxes, capsules, first),
        )
    first_row, after_last = np.asarray(shapes.rows)
    ahead = (corners[2] > 0.05).all(axis=0)
    assert np.median((after_last - first_row)[ahead]) < 90
    assert (~ahead).any()


def test_lists_hold_the_solids_that_reach_into_each_tile_in_order():
    reaches = np.random.default_rng(0).random((7, 200)) < 0.1
    reaches[3] = False
    listed = compact(jnp.asarray(reaches), 5)
    for row, indices, count in zip(reaches, np.asarray(listed.indices), np.asarray(listed.n_reaching), strict=True):
        np.testing.assert_array_equal(indices[:count], 5 + np.flatnonzero(row))
