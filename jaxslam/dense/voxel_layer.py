"""One grid of voxels, and what each keyframe has put into it, so that its points move when the keyframe does.

Not safe to be used from several threads at once.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxlie import SE3
from jaxslam_kernels.camera import Intrinsics
from jaxslam_kernels.free_space import seen_from
from jaxslam_kernels.transform import to_world
from jaxslam_kernels.voxel_grid import (
    VoxelGrid,
    Voxels,
    centroids,
    changed,
    empty_grid,
    reduced_cloud,
    weighed,
    with_cloud,
)
from jaxslam_kernels.voxel_hash import NO_ROW
from jaxtyping import Array, Bool, Float, Float32, Int, Int32

from jaxslam.dense.view import Looks, View
from jaxslam.padding import padded
from jaxslam.xla import IN_ITS_THREAD

HIT, MISS = np.float32(0.85), np.float32(-0.85)
"""Log-odds of a voxel that a keyframe has a point in: a probability of 0.7, OctoMap's; and of one it sees past. That is
0.4 in OctoMap, for rays that graze a surface; here it must be clearly behind, and says as much as a point does."""
_SEEN = np.float32(0.4)
"""What a surface where a voxel has its points says for it: less than new points do."""
_GONE = -1.0
"""Points in voxels with less do not go with their keyframe when it is moved."""
_MOST_PAST = 3
"""Earlier keyframes that see past a new point of which no more count: something may have been put there since."""
_SAME_SHARE, _SAME_M = 0.03, 0.03
"""Differences of depth that are none, a share and metres: sensors are a percent or two off at four metres."""
_CHUNK = 65536
"""Voxels compared with a depth image in one call."""
_FULL, _STILL_FULL = 0.9, 0.7
"""Shares of the voxels in use from which free ones are forgotten, and with which voxels become larger."""


class Part(NamedTuple):
    """What a keyframe has in the grid.

    Attributes:
        X_cam: `(3, m)` in units of the layer, int16.
        colour: `(3, m)` uint8.
        counts: `(m,)` float16.
        rows: `(m,)` of the grid; `NO_ROW` of points that have left it.
        T_world_cam: `(7,)` where the keyframe was when they were put there; `None` while they are not in the grid.
    """

    X_cam: np.ndarray
    colour: np.ndarray
    counts: np.ndarray
    rows: Int32[np.ndarray, " m"]
    T_world_cam: np.ndarray | None

    @property
    def nbytes(self) -> int:
        """What it takes up."""
        return self.X_cam.nbytes + self.colour.nbytes + self.counts.nbytes + self.rows.nbytes


class VoxelLayer:
    """A grid of voxels of one size.

    Attributes:
        voxel_m: Side of a voxel; it doubles when the grid is full.
        parts: Of keyframes, by their ids.
        unit_m: Of the coordinates of parts.
    """

    def __init__(self, capacity: int, part_points: int, voxel_m: float, farthest_m: float) -> None:
        """Begin empty.

        Args:
            capacity: Voxels at most.
            part_points: Points of a keyframe at most.
            voxel_m: Side of a voxel.
            farthest_m: No point of a keyframe is further from it along any axis but by the view of its camera.
        """
        self.voxel_m = voxel_m
        self.parts: dict[int, Part] = {}
        self._capacity, self._part_points = capacity, part_points
        self.unit_m = np.float32(4 * farthest_m / 32767)  # views are up to 150 degrees wide
        self._grid = empty_grid(capacity)

    def reduce(
        self, X_cam: Float32[np.ndarray, "3 n"], colours: Float32[np.ndarray, "3 n"], mask: Bool[np.ndarray, " n"]
    ) -> Part:
        """The points of a keyframe, one a voxel in its own axes; voxels are larger if there are too many."""
        voxel_m = self.voxel_m
        while True:
            voxels: Voxels = _reduced(X_cam, colours, mask, np.float32(voxel_m), self._part_points)
            num = int(voxels.num)
            if num <= self._part_points:
                break
            voxel_m *= 1.05 * np.sqrt(num / self._part_points)  # surfaces have so many
        X, colour, count = (np.asarray(array)[..., :num] for array in voxels[:3])
        X = np.clip(np.rint(X / self.unit_m), -32767, 32767).astype(np.int16)
        return Part(X, np.rint(colour).astype(np.uint8), count.astype(np.float16), np.full(num, NO_ROW, np.int32), None)

    def put(
        self, keyframe: int, part: Part, T_world_cam: np.ndarray, past: Int[np.ndarray, " m"] | None = None
    ) -> None:
        """Put the points of a keyframe into the grid.

        Args:
            keyframe: Its id.
            part: Its points.
            T_world_cam: `(7,)` its pose.
            past: `(m,)` how many earlier keyframes see past each.
        """
        evidence = np.full(len(part.counts), HIT)
        if past is not None:
            evidence += MISS * np.minimum(past, _MOST_PAST)
        pose = T_world_cam.astype(np.float32)
        self._grid, rows = _put(self._grid, *self._padded(part, evidence), pose, np.float32(self.voxel_m))
        rows = np.array(rows)[: len(part.rows)]
        self.parts[keyframe] = part._replace(rows=rows, T_world_cam=T_world_cam)

    def take_out(self, keyframe: int, which: Bool[np.ndarray, " m"] | None = None) -> Part:
        """Take points of a keyframe out of the grid: all, or some for good; gives what is left of it."""
        part = self.parts[keyframe]
        if part.T_world_cam is None:
            left = part if which is None else _at(part, ~which)
            self.parts[keyframe] = left
            return left
        evidence = np.full(len(part.counts), -HIT)
        X, colour, count, evidence = self._padded(part, evidence)
        rows = padded(part.rows, self._part_points, fill=NO_ROW)
        if which is not None:
            rows = np.where(padded(which, self._part_points, fill=False), rows, np.int32(NO_ROW))
        pose = part.T_world_cam.astype(np.float32)
        self._grid = _taken_out(self._grid, rows, X, colour, count, evidence, pose, np.float32(self.voxel_m))
        left = part._replace(T_world_cam=None) if which is None else _at(part, ~which)
        self.parts[keyframe] = left
        return left

    def move(self, keyframe: int, T_world_cam: np.ndarray | None) -> None:
        """Move the points of a keyframe with it, or out of the grid; those found to be gone stay out."""
        part = self.parts[keyframe]
        if part.T_world_cam is not None:
            odds = np.asarray(self._grid.sums)[np.maximum(part.rows, 0), 7]
            stays = (part.rows != NO_ROW) & (odds > _GONE)
            part = _at(self.take_out(keyframe), stays)
            self.parts[keyframe] = part
        if T_world_cam is not None:
            self.put(keyframe, part, T_world_cam)

    def forget(self, keyframe: int) -> None:
        """Leave the points of a keyframe where they are, for good."""
        del self.parts[keyframe]

    def look(self, looks: Looks, T_world_cam: np.ndarray, view: View) -> None:
        """Take in which voxels a frame sees again, and which it sees past."""
        for start in range(0, int(self._grid.table.num), _CHUNK):
            self._look_from(start, looks, T_world_cam, view)

    def past(self, part: Part, T_world_cam: np.ndarray, looks: Looks, poses: np.ndarray, view: View) -> np.ndarray:
        """`(m,)` how many of `(k, h, w)` depth images, taken at `(k, 7)` poses, see past the points of a keyframe."""
        X = self._padded(part, np.zeros(len(part.counts), np.float32))[0]
        arrays = T_world_cam.astype(np.float32), looks.depth, looks.least, poses.astype(np.float32), view.intrinsics
        return np.asarray(_num_past(X, *arrays))[: len(part.counts)]

    def make_room(self) -> None:
        """Forget free voxels when the grid is nearly full, and if that does not help, make voxels larger."""
        if int(self._grid.table.num) < _FULL * self._capacity:
            return
        self._rebuild(1)
        while int(self._grid.table.num) >= _STILL_FULL * self._capacity:
            self._rebuild(2)

    def shown(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Points `(n, 3)`, colours `(n, 3)` and counts `(n,)` of voxels that have some and are not free."""
        num = int(self._grid.table.num)
        voxels = _all_centroids(self._grid, np.float32(self.voxel_m))
        keep = (np.asarray(voxels.counts)[:num] > 0) & (np.asarray(self._grid.sums)[:num, 7] > 0)
        X, colour, count = (np.asarray(array)[..., :num][..., keep] for array in voxels[:3])
        colour = np.clip(np.rint(colour), 0, 255).astype(np.uint8)
        return np.ascontiguousarray(X.T), np.ascontiguousarray(colour.T), count

    def compile(self, view: View, small: View, num_looks: int, points: int) -> None:
        """Compile all that is needed, on a grid that holds nothing.

        Args:
            view: Of new depth images.
            small: Of earlier ones.
            num_looks: Earlier ones that new points are compared with.
            points: Points that `reduce` gets.
        """
        pose = np.array([1.0, 0, 0, 0, 0, 0, 0])
        nothing = np.zeros((3, points), np.float32)
        part = self.reduce(nothing, nothing, np.zeros(points, bool))
        self.put(NO_ROW, part, pose)
        self.move(NO_ROW, pose)
        del self.parts[NO_ROW]
        blank = np.zeros((num_looks, *small.shape), np.float32)
        self.past(part, pose, Looks(blank, blank), np.tile(pose, (num_looks, 1)), small)
        for used in (view, small):
            self._look_from(0, used.looks(np.zeros(used.shape, np.float32)), pose, used)
        self.shown()

    @property
    def nbytes(self) -> int:
        """Memory in use, bytes: of the grid, whatever is in it, and of the parts."""
        return sum(leaf.nbytes for leaf in jax.tree.leaves(self._grid)) + self.part_bytes

    @property
    def part_bytes(self) -> int:
        """Memory in use for the parts of keyframes."""
        return sum(part.nbytes for part in self.parts.values())

    def _look_from(self, start: int, looks: Looks, T_world_cam: np.ndarray, view: View) -> None:
        pose, size = T_world_cam.astype(np.float32), np.float32(self.voxel_m)
        self._grid = _looked(self._grid, np.int32(start), pose, *looks, view.intrinsics, size)

    def _padded(self, part: Part, evidence: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Points, colours, counts and evidence of a part at the size programs are compiled for."""
        size = self._part_points
        X, colour = (padded(array.astype(np.float32), size, axis=1) for array in (part.X_cam, part.colour))
        return X * self.unit_m, colour, padded(part.counts.astype(np.float32), size), padded(evidence, size)

    def _rebuild(self, factor: int) -> None:
        """The same grid with larger voxels, or as large ones, without those that are free."""
        old, self.voxel_m = np.float32(self.voxel_m), self.voxel_m * factor
        self._grid, rows = _rebuilt(self._grid, old, np.float32(self.voxel_m), self._capacity)
        new = np.append(np.asarray(rows), np.int32(NO_ROW))
        for keyframe, part in self.parts.items():
            if part.T_world_cam is not None:
                self.parts[keyframe] = part._replace(rows=new[part.rows])


def _at(part: Part, which: Bool[np.ndarray, " m"]) -> Part:
    return Part(part.X_cam[:, which], part.colour[:, which], part.counts[which], part.rows[which], part.T_world_cam)


_reduced = jax.jit(
    lambda X, colours, mask, voxel_m, capacity: reduced_cloud(X, colours, mask, voxel_m, capacity=capacity),
    static_argnums=4,
    compiler_options=IN_ITS_THREAD,
)


@partial(jax.jit, donate_argnums=0, compiler_options=IN_ITS_THREAD)
def _put(
    grid: VoxelGrid, X_cam: Array, colour: Array, count: Array, evidence: Array, pose: Array, voxel_m: Array
) -> tuple[VoxelGrid, Int[Array, " m"]]:
    return with_cloud(grid, to_world(SE3(pose), X_cam), colour, count, evidence, voxel_m)


@partial(jax.jit, donate_argnums=0, compiler_options=IN_ITS_THREAD)
def _taken_out(
    grid: VoxelGrid,
    rows: Array,
    X_cam: Array,
    colour: Array,
    count: Array,
    evidence: Array,
    pose: Array,
    voxel_m: Array,
) -> VoxelGrid:
    return changed(grid, rows, to_world(SE3(pose), X_cam), colour, -count, evidence, voxel_m)


@partial(jax.jit, donate_argnums=0, compiler_options=IN_ITS_THREAD)
def _looked(
    grid: VoxelGrid,
    start: Int[Array, ""],
    pose: Float[Array, "7"],
    depth: Float[Array, "h w"],
    least: Float[Array, "h w"],
    intrinsics: Intrinsics,
    voxel_m: Float[Array, ""],
) -> VoxelGrid:
    size = min(_CHUNK, len(grid.sums))
    first = jnp.minimum(start, len(grid.sums) - size)
    voxels = centroids(grid, first, voxel_m, size=size)
    seen = seen_from(
        voxels.X, SE3(pose), depth, least, intrinsics, same_share=jnp.float32(_SAME_SHARE), same_m=jnp.float32(_SAME_M)
    )
    counts = (voxels.counts > 0) & (first + jnp.arange(size, dtype=jnp.int32) >= start)
    evidence = jnp.where(seen.past, MISS, jnp.where(seen.there, _SEEN, 0))
    return weighed(grid, first, jnp.where(counts, evidence, 0))


@partial(jax.jit, compiler_options=IN_ITS_THREAD)
def _num_past(
    X_cam: Float[Array, "3 m"],
    pose: Float[Array, "7"],
    depths: Float[Array, "k h w"],
    leasts: Float[Array, "k h w"],
    poses: Float[Array, "k 7"],
    intrinsics: Intrinsics,
) -> Int[Array, " m"]:
    X_world = to_world(SE3(pose), X_cam)

    def look(depth: Array, least: Array, other: Array) -> Array:
        seen = seen_from(
            X_world,
            SE3(other),
            depth,
            least,
            intrinsics,
            same_share=jnp.float32(_SAME_SHARE),
            same_m=jnp.float32(_SAME_M),
        )
        return seen.past.astype(jnp.int32)

    return jnp.sum(jax.vmap(look)(depths, leasts, poses), axis=0)


@jax.jit
def _all_centroids(grid: VoxelGrid, voxel_m: Float[Array, ""]) -> Voxels:
    return centroids(grid, jnp.zeros((), jnp.int32), voxel_m, size=len(grid.sums))


@partial(jax.jit, static_argnums=3)
def _rebuilt(
    grid: VoxelGrid, old_m: Float[Array, ""], new_m: Float[Array, ""], capacity: int
) -> tuple[VoxelGrid, Int[Array, " c"]]:
    voxels = centroids(grid, jnp.zeros((), jnp.int32), old_m, size=capacity)
    count = jnp.where(grid.log_odds > 0, voxels.counts, 0)
    return with_cloud(empty_grid(capacity), voxels.X, voxels.colour, count, grid.log_odds, new_m)
