"""Blocks of rows in view, against all points one by one."""

import numpy as np
from small_scene import clip

from jaxslam.dense.block_bounds import RowBoxes
from jaxslam.dense.depth_view import DepthView
from jaxslam.geometry.se3 import IDENTITY, retract, to_local

VOXEL_M = 0.02


def _boxes() -> tuple[RowBoxes, np.ndarray]:
    """Forty blocks of ten rows, each around a place of its own."""
    rng = np.random.default_rng(0)
    places = rng.uniform(-8, 8, (3, 40))
    X = (np.repeat(places, 10, axis=1) + rng.uniform(-0.2, 0.2, (3, 400))).astype(np.float32)
    boxes = RowBoxes(450, 10)
    boxes.add(np.arange(400), X)
    return boxes, X


def test_what_is_seen_is_in_view() -> None:
    """No block of which the camera sees a point is left out, and most of the others are."""
    boxes, X = _boxes()
    view = DepthView(clip().camera, 2, 6.0, 0.3)
    rng = np.random.default_rng(1)
    for _ in range(20):
        pose = retract(IDENTITY, rng.normal(0, 1, 6))
        x, y, z = to_local(pose, X)
        (left, top), (right, bottom) = view.borders
        seen = (z > 0.3) & (z < 6) & (x > left * z) & (x < right * z) & (y > top * z) & (y < bottom * z)
        there = set((np.flatnonzero(seen) // 10).tolist())
        chosen = boxes.in_view(pose, view, VOXEL_M).tolist()
        assert there <= set(chosen)
        assert len(chosen) <= len(there) + 8 < 40


def test_nothing_there() -> None:
    boxes, _ = _boxes()
    assert len(boxes) == 45
    boxes.clear()
    assert len(boxes.in_view(IDENTITY, DepthView(clip().camera, 2, 6.0, 0.3), VOXEL_M)) == 0
