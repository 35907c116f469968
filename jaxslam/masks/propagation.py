"""A mask carried from one frame to a later one: its points followed by flow, and its outline found anew by depth.

Source: NGD-SLAM (Zhang, Cheng and Kaess 2025), section III-B: dynamic flow, clustering by DBSCAN, prediction of the
mask from the depth of each cluster. The paper leaves open how the mask grows from a cluster: here it is where its part
of the old mask has moved to, and a little around, as far as it has the cluster's depth and hangs together with its
points. What people touch joins them nevertheless: on Bonn `crowd`, thirty frames after the last detection, the mask
agrees with DeepLab's with a median IoU of 0.18 only, and 0.74 while detections come two frames late.
"""

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import cv2
import jax
import jax.numpy as jnp
import numpy as np
from jaxslam_kernels.dbscan import dbscan
from jaxslam_kernels.image import Pyramid
from jaxslam_kernels.lk_flow import lk_flow
from jaxslam_kernels.types import Mask, Pixels
from jaxtyping import Array, Bool, Float, Int

from jaxslam.padding import padded

CAPACITY = 256
"""Most points."""
_NEIGHBOURS_PX = 40.0
"""Points of one object are at most so far apart in the image,"""
_PX_PER_M = 200.0
"""a metre of depth counting as so many pixels,"""
_LEAST_NEIGHBOURS = 5
"""and every one that says anything has so many neighbours, itself included."""
_GROW_PX = 9
_DEPTH_RANGE = (5, 95)
"""Percentiles of the depth of a cluster's points,"""
_DEPTH_MARGIN_M = 0.2
"""and how much farther the object may reach."""
_LEAST_SHARE = 0.1
"""A piece of the new mask holds at least this share of the cluster's points."""


class MaskAt(NamedTuple):
    """A mask of a frame of the past.

    Attributes:
        frame: Its number.
        mask: `(h, w)` true where something moves or may.
    """

    frame: int
    mask: Bool[np.ndarray, "h w"]


class Followed(NamedTuple):
    """Points of a mask, now and before; padded to a fixed size.

    Attributes:
        before: `(2, n)` pixels where they were sampled.
        now: `(2, n)` pixels.
        ok: `(n,)` which were followed all the way.
    """

    before: np.ndarray
    now: np.ndarray
    ok: np.ndarray


def follow(pyramids: Sequence[Pyramid], sampled: np.ndarray) -> Followed:
    """Follow points through frames, from the first to the last.

    Args:
        pyramids: Of the frame they were sampled in and of every one since.
        sampled: `(2, k)` pixels, at most `CAPACITY`.
    """
    uv = padded(sampled.astype(np.float32), CAPACITY, axis=1)
    before, ok = uv, np.arange(CAPACITY) < sampled.shape[1]
    now = uv
    for a, b in itertools.pairwise(pyramids):
        now, ok = _flow(a, b, now, ok)
    return Followed(before, np.asarray(now), np.asarray(ok))


def predicted_mask(
    mask: Bool[np.ndarray, "h w"], followed: Followed, depth: Float[np.ndarray, "h w"]
) -> Bool[np.ndarray, "h w"]:
    """Where the objects of a mask are after their points have moved.

    Args:
        mask: The mask the points were sampled in.
        followed: Its points.
        depth: Of the new frame, metres, 0 where missing.
    """
    known, z = depth_at(depth, followed)
    label = np.asarray(_clusters(followed.now, z, known))
    new = np.zeros_like(mask)
    _, piece = cv2.connectedComponents(mask.astype(np.uint8), connectivity=4)
    for cluster in range(int(label.max(initial=-1)) + 1):
        of_it = label == cluster
        column, row = np.round(followed.before[:, of_it]).astype(np.int64)
        old = np.isin(piece, np.setdiff1d(piece[row, column], [0]))
        _add_object(new, old, followed.before[:, of_it], followed.now[:, of_it], z[of_it], depth)
    return new


def depth_at(depth: np.ndarray, followed: Followed) -> tuple[np.ndarray, np.ndarray]:
    """Which points have depth where they are now, and what; 0 for the others."""
    column, row = np.round(np.where(followed.ok, followed.now, 0)).astype(np.int64)
    inside = (row >= 0) & (row < depth.shape[0]) & (column >= 0) & (column < depth.shape[1])
    z = np.where(inside, depth[np.where(inside, row, 0), np.where(inside, column, 0)], 0)
    known = followed.ok & inside & np.isfinite(z) & (z > 0)
    return known, np.where(known, z, 0).astype(np.float32)


def _add_object(
    new: np.ndarray, old: np.ndarray, before: np.ndarray, now: np.ndarray, z: np.ndarray, depth: np.ndarray
) -> None:
    """Add one object to the new mask: its part of the old one moved, cut by depth, and connected to its points.

    Its part is every piece of the old mask that holds one of its points: of people who overlap, depth keeps the others
    out. Cut to what is near its points, masks had holes where flow had failed.
    """
    height, width = old.shape
    rows, columns = np.flatnonzero(old.any(axis=1)), np.flatnonzero(old.any(axis=0))
    if not len(rows):
        return
    left, top, right, bottom = columns[0], rows[0], columns[-1] + 1, rows[-1] + 1
    shift = np.round(np.median(now - before, axis=1)).astype(int)
    reach = _GROW_PX + max(right - left, bottom - top) // 20  # what comes nearer grows
    moved = np.zeros((bottom - top + 2 * reach, right - left + 2 * reach), np.uint8)
    moved[reach:-reach, reach:-reach] = old[top:bottom, left:right]
    around = cv2.dilate(moved, np.ones((2 * reach + 1, 2 * reach + 1), np.uint8))
    origin = np.array([left, top]) + shift - reach
    begin = np.clip(origin, 0, [width, height])
    end = np.clip(origin + np.array(around.shape[::-1]), 0, [width, height])
    if (end <= begin).any():
        return
    here = slice(begin[1], end[1]), slice(begin[0], end[0])
    there = slice(begin[1] - origin[1], end[1] - origin[1]), slice(begin[0] - origin[0], end[0] - origin[0])
    nearest, farthest = np.percentile(z, _DEPTH_RANGE)
    inside = depth[here]
    right_depth = (inside > nearest - _DEPTH_MARGIN_M) & (inside < farthest + _DEPTH_MARGIN_M)
    num, piece = cv2.connectedComponents(((around[there] > 0) & right_depth).astype(np.uint8), connectivity=4)
    column, row = np.round(now).astype(int) - begin[:, None]
    in_view = (row >= 0) & (row < piece.shape[0]) & (column >= 0) & (column < piece.shape[1])
    hits = np.bincount(piece[row[in_view], column[in_view]], minlength=num)
    hits[0] = 0  # the background
    new[here] |= (hits >= max(2, _LEAST_SHARE * now.shape[1]))[piece]


@jax.jit
def _flow(before: Pyramid, now: Pyramid, uv: Pixels, ok: Mask) -> tuple[Pixels, Mask]:
    flow = lk_flow(before, now, uv, mask=ok)
    return flow.points, flow.ok


@jax.jit
def _clusters(uv: Pixels, z: Float[Array, " n"], known: Mask) -> Int[Array, " n"]:
    points = jnp.concatenate([uv, _PX_PER_M * z[None]])
    return dbscan(points, known, radius=_NEIGHBOURS_PX, min_points=_LEAST_NEIGHBOURS).label
