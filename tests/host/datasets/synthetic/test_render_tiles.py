"""Tiles of a rendered picture, put together."""

import numpy as np
import pytest

from jaxslam.datasets.synthetic.culling import Tiling
from jaxslam.datasets.synthetic.render import untiled


@pytest.mark.parametrize("size", [(480, 640), (370, 1226), (61, 79), (33, 160)])
@pytest.mark.parametrize("share", [1, 3])
def test_every_pixel_is_where_it_was(size: tuple[int, int], share: int) -> None:
    height, width = size
    tiling = Tiling.of(height, width)
    padded = np.arange(tiling.rows * tiling.height * tiling.columns * tiling.width).reshape(
        tiling.rows * tiling.height, tiling.columns * tiling.width
    )
    tiles = padded.reshape(tiling.rows, tiling.height, tiling.columns, tiling.width).swapaxes(1, 2)
    parts = [tiles[first : first + share] for first in range(0, tiling.rows, share)]
    plane = untiled(parts, height, width)
    assert plane.flags.c_contiguous
    np.testing.assert_array_equal(plane, padded[:height, :width])
