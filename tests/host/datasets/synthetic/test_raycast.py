"""Rays against solids: the tiles, and their rows, in which a solid is looked for."""

from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxslam.datasets.synthetic.culling import (
    Tiling,
    list_candidates,
    rows_of_solids,
    solids_in_tiles,
)
from jaxslam.datasets.synthetic.raycast import Rays, Shapes, nearest_solid

INTRINSICS = np.array([300.0, 300.0, 319.5, 239.5], np.float32)
TILING = Tiling.of(480, 640)
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
    return Shapes(jnp.asarray(unit_from_cam), jnp.asarray(stem, jnp.float32)), corners


def rays_of_tile(row: int, column: int) -> Rays:
    v, u = np.divmod(np.arange(TILING.height * TILING.width), TILING.width)
    x = (u + column * TILING.width - INTRINSICS[2]) / INTRINSICS[0]
    y = (v + row * TILING.height - INTRINSICS[3]) / INTRINSICS[1]
    return Rays(*(jnp.asarray(each, jnp.float32) for each in (x, y, v / TILING.height)))


@pytest.mark.parametrize("seed", range(3))
def test_no_ray_meets_a_solid_outside_its_tiles_and_rows(seed):
    shapes, corners = scattered(seed)
    once = jnp.asarray(corners, jnp.float32)[None]
    reaches = np.array(solids_in_tiles(once, jnp.asarray(INTRINSICS), TILING))
    rows = np.asarray(rows_of_solids(once[0], jnp.asarray(INTRINSICS)))[None]
    reaches[:, 0] = False
    everywhere = np.ones_like(reaches)
    everywhere[:, 0] = False
    anywhere = np.broadcast_to([[-1_000_000], [1_000_000]], rows.shape)
    found = list_candidates(reaches, rows, NUM_BOXES, TILING)
    every = list_candidates(everywhere, anywhere, NUM_BOXES, TILING)
    assert found.begins[-1, -1] < 0.3 * every.begins[-1, -1]
    cast = jax.jit(nearest_solid, static_argnames="tiling")
    for row in range(TILING.rows):
        tile = row * TILING.columns + 3
        rays = rays_of_tile(row, 3)
        of_tile = lambda candidates, tile=tile: candidates._replace(begins=candidates.begins[tile])
        np.testing.assert_array_equal(
            cast(shapes, rays, of_tile(found), tiling=TILING), cast(shapes, rays, of_tile(every), tiling=TILING)
        )
    first_row, after_last = rows[0]
    ahead = (corners[2] > 0.05).all(axis=0)
    assert np.median((after_last - first_row)[ahead]) < 90
    assert (~ahead).any()


@pytest.mark.parametrize("by_row", [False, True])
def test_lists_hold_the_solids_that_reach_into_each_tile_by_kind_and_window(by_row):
    rng = np.random.default_rng(0)
    reaches = rng.random((TILING.rows * TILING.columns, 200)) < 0.1
    reaches[3] = False
    first = rng.integers(0, 480, (TILING.rows if by_row else 1, 200))
    rows = np.stack([first, first + rng.integers(1, 100, first.shape)], axis=1)
    listed = list_candidates(reaches, rows, 120, TILING)
    windows = TILING.windows
    for tile, begins in enumerate(listed.begins):
        np.testing.assert_array_equal(np.sort(listed.solids[begins[0] : begins[-1]]), np.flatnonzero(reaches[tile]))
        row = tile // TILING.columns
        for group, (begin, end) in enumerate(pairwise(begins)):
            solids, window = listed.solids[begin:end], windows[group % len(windows)]
            assert ((solids >= 120) == (group >= len(windows))).all()
            above, below = np.clip(rows[row if by_row else 0][:, solids] - 60 * row, 0, 60)
            top = listed.first_rows[begin:end]
            assert (top <= above).all()
            assert (below <= top + window).all()
            assert (top + window <= 60).all()
            smaller = [each for each in windows if each < window]
            assert not smaller or (below - above > smaller[-1]).all()


@pytest.mark.parametrize(("height", "width"), [(480, 640), (370, 1226), (8, 8), (61, 81), (2160, 3840)])
def test_tiles_cover_the_picture_and_little_more(height, width):
    tiling = Tiling.of(height, width)
    assert height <= tiling.rows * tiling.height < height + tiling.rows
    assert width <= tiling.columns * tiling.width < width + tiling.width
    assert tiling.height <= 60
    assert list(tiling.windows) == sorted(set(tiling.windows))
    assert tiling.windows[-1] == tiling.height
