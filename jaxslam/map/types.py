"""The map: keyframes, points, and the observations of points in keyframes.

A `Map` is immutable: an edit returns a new one that shares all unchanged arrays, so any thread can read a map without
locks. Rows are sorted by id, and an id is never assigned twice.

What a keyframe or a frame needs of a large map is around some keyframes: `Map.around` returns it at a cost that depends
on what is there. `Map.points` and `Map.observations` are all of them, which takes longer the larger the map is.
"""

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from jaxtyping import Float64, Int, Int32, Int64

from jaxslam.features.orb import Features
from jaxslam.geometry.se3 import IDENTITY, compose
from jaxslam.geometry.types import Ids, Pose
from jaxslam.map.contents import MapContents
from jaxslam.map.point_records import (
    NONE,
    MapPoints,
    Observations,
    distinct,
    empty_observations,
    empty_points,
    has,
    rows,
)
from jaxslam.sensors.camera import Camera

if TYPE_CHECKING:
    from scipy.sparse import csr_array

_NO_IDS = np.zeros(0, np.int64)


class Keyframe(NamedTuple):
    """A keyframe. It never changes, except that its features on dynamic objects may be removed.

    Attributes:
        id: Id of the keyframe.
        timestamp_ns: Time of the image, nanoseconds.
        features: ORB features of the image.
        image_file: Gray image, compressed: JPEG, or PNG in a map of an earlier version.
    """

    id: int
    timestamp_ns: int
    features: Features
    image_file: bytes


class Loops(NamedTuple):
    """The `l` loop constraints: relative poses measured when a place was recognized.

    Attributes:
        source: `(l,)` ids of the keyframes in whose frame the relative pose is given.
        target: `(l,)` ids of the other keyframes.
        T_source_target: `(l, 7)` poses of the targets relative to the sources, `wxyz_xyz`.
        information: `(l, 6, 6)` inverse covariances of the relative poses; the tangent is translation, then rotation.
    """

    source: Int64[np.ndarray, " l"]
    target: Int64[np.ndarray, " l"]
    T_source_target: Float64[np.ndarray, "l 7"]
    information: Float64[np.ndarray, "l 6 6"]


class Culled(NamedTuple):
    """The `c` culled keyframes: their poses relative to other keyframes are kept for the trajectory.

    Attributes:
        ids: `(c,)` ids of the culled keyframes, in the order in which they were culled.
        anchor: `(c,)` ids of the keyframes relative to which their poses are stored; an anchor may be culled later.
        T_anchor_keyframe: `(c, 7)` poses relative to the anchors, `wxyz_xyz`.
    """

    ids: Int64[np.ndarray, " c"]
    anchor: Int64[np.ndarray, " c"]
    T_anchor_keyframe: Float64[np.ndarray, "c 7"]


class Map(NamedTuple):
    """The immutable map of `k` keyframes.

    Attributes:
        camera: Camera of all keyframes.
        keyframes: The keyframes, ascending by id.
        ids: `(k,)` ids of the keyframes.
        T_world_cam: `(k, 7)` poses of the keyframes, `wxyz_xyz`.
        parent: `(k,)` id of each keyframe's parent in the spanning tree; `NONE` for the first keyframe of a submap.
        submap: `(k,)` number of the submap of each keyframe; the keyframes of a submap share a world frame.
        contents: The points and their observations.
        loops: The loops closed so far.
        culled: The keyframes culled so far.
        next_keyframe: Id of the next keyframe to be added.
        next_point: Id of the next point to be added.
    """

    camera: Camera
    keyframes: tuple[Keyframe, ...]
    ids: Int64[np.ndarray, " k"]
    T_world_cam: Float64[np.ndarray, "k 7"]
    parent: Int64[np.ndarray, " k"]
    submap: Int32[np.ndarray, " k"]
    contents: MapContents
    loops: Loops
    culled: Culled
    next_keyframe: int
    next_point: int

    @property
    def points(self) -> MapPoints:
        """All points of the map."""
        return self.contents.points

    @property
    def observations(self) -> Observations:
        """All observations of points in keyframes."""
        return self.contents.observations

    @property
    def world_submap(self) -> int:
        """Number of the earliest submap, into whose frame the others are merged."""
        return int(self.submap.min()) if len(self.submap) else 0

    def row(self, keyframe_id: int | np.integer) -> int:
        """Return the row of a keyframe.

        Raises:
            KeyError: If the keyframe is not in the map.
        """
        # Of one id in plain Python: `rows` takes five times as long, and every frame asks for a few.
        at = int(self.ids.searchsorted(keyframe_id))
        if at == len(self.ids) or self.ids[at] != keyframe_id:
            raise KeyError(f"not in the map: [{keyframe_id}]")
        return at

    def has_keyframe(self, keyframe_id: int | np.integer) -> bool:
        """Return whether a keyframe is in the map, and not culled."""
        at = int(self.ids.searchsorted(keyframe_id))
        return at < len(self.ids) and bool(self.ids[at] == keyframe_id)

    def surviving_keyframe(self, keyframe_id: int) -> int:
        """Return a keyframe's id, or if it was culled, that of its anchor that is still in the map.

        Raises:
            KeyError: If the keyframe was never in this map.
        """
        return self._anchored(keyframe_id)[0]

    def _anchored(self, keyframe_id: int) -> tuple[int, Pose]:
        """Return the keyframe still in the map that another one is anchored to, and the other's pose relative to it."""
        T_anchor_keyframe = IDENTITY
        while not self.has_keyframe(keyframe_id):
            found = np.flatnonzero(self.culled.ids == keyframe_id)
            if not len(found):
                raise KeyError(f"keyframe {keyframe_id} was never in this map")
            T_anchor_keyframe = compose(self.culled.T_anchor_keyframe[found[0]], T_anchor_keyframe)
            keyframe_id = int(self.culled.anchor[found[0]])
        return keyframe_id, T_anchor_keyframe

    def keyframe(self, keyframe_id: int) -> Keyframe:
        """Return a keyframe.

        Raises:
            KeyError: If the keyframe is not in the map.
        """
        return self.keyframes[self.row(keyframe_id)]

    def pose(self, keyframe_id: int) -> Pose:
        """Return the pose `T_world_cam` of a keyframe, which may have been culled.

        Raises:
            KeyError: If the keyframe was never in this map.
        """
        anchor, T_anchor_keyframe = self._anchored(keyframe_id)
        return compose(self.T_world_cam[self.row(anchor)], T_anchor_keyframe)

    def with_arrays(self, points: MapPoints | None = None, observations: Observations | None = None) -> "Map":
        """Return the map with other points, other observations, or both, instead of all that it has."""
        contents = MapContents(
            self.points if points is None else points, self.observations if observations is None else observations
        )
        return self._replace(contents=contents)

    def in_blocks(self) -> "Map":
        """Return the map with its points and observations in blocks; itself if they are."""
        return self if self.contents.has_blocks else self._replace(contents=self.contents.as_blocks())

    def around(self, keyframe_ids: Ids, point_ids: Ids | None = None) -> "Map":
        """Return a map of all keyframes with at least the points that some keyframes observe, and some points.

        All observations of those points are in it. A map that is a part of another one is returned whole.

        Args:
            keyframe_ids: Ids of the keyframes.
            point_ids: Ids of the points; none by default.
        """
        return self._replace(contents=self.contents.around(keyframe_ids, _NO_IDS if point_ids is None else point_ids))


def empty_map(camera: Camera) -> Map:
    """Create an empty map."""
    none = np.zeros(0, np.int64)
    return Map(
        camera=camera,
        keyframes=(),
        ids=none,
        T_world_cam=np.zeros((0, 7)),
        parent=none,
        submap=np.zeros(0, np.int32),
        contents=MapContents(empty_points(), empty_observations()),
        loops=Loops(none, none, np.zeros((0, 7)), np.zeros((0, 6, 6))),
        culled=Culled(none, none, np.zeros((0, 7))),
        next_keyframe=0,
        next_point=0,
    )


def visibility(slam_map: Map) -> "csr_array":
    """Return the sparse `(k, p)` matrix that is 1 where a keyframe observes a point."""
    from scipy.sparse import csr_array  # noqa: PLC0415 - see `runtime.preload`

    at = (rows(slam_map.ids, slam_map.observations.keyframe), rows(slam_map.points.ids, slam_map.observations.point))
    return csr_array((np.ones(len(at[0]), np.int32), at), shape=(len(slam_map.ids), len(slam_map.points.ids)))


def covisible(
    slam_map: Map, keyframe_id: int, at_least: int = 15
) -> tuple[Int[np.ndarray, " k"], Int[np.ndarray, " k"]]:
    """Return the covisible keyframes: its neighbors in the covisibility graph.

    Args:
        slam_map: The map.
        keyframe_id: Id of a keyframe.
        at_least: Fewest points that a neighbor shares with it.

    Returns:
        `(k,)` ids of the neighbors, the most shared points first, and `(k,)` numbers of shared points.
    """
    slam_map = slam_map.around(np.array([keyframe_id]))
    mine = slam_map.observations.point[slam_map.observations.keyframe == keyframe_id]
    ids, counts = observers(slam_map, mine)
    near = (ids != keyframe_id) & (counts >= at_least)
    return ids[near], counts[near]


def observers(slam_map: Map, point_ids: Ids) -> tuple[Int[np.ndarray, " k"], Int[np.ndarray, " k"]]:
    """Return the keyframes that observe some points, and how many of them each observes.

    The most come first, newer keyframes first if equal.
    """
    slam_map = slam_map.around(point_ids[:0], point_ids)
    seen = has(distinct(point_ids)[0], slam_map.observations.point)
    ids, counts = distinct(slam_map.observations.keyframe[seen])
    order = np.lexsort((-ids, -counts))
    return ids[order], counts[order]


def neighborhood(slam_map: Map, keyframe_id: int, at_least: int = 15, at_most: int = 20) -> tuple[Ids, Ids]:
    """Return the local map around a keyframe.

    Args:
        slam_map: The map.
        keyframe_id: Id of a keyframe.
        at_least: Fewest points that a neighbor shares with it.
        at_most: Largest number of neighbors.

    Returns:
        Ids of the keyframe and its neighbors, the most shared points first, and the ascending ids of the points that
        they observe. The parent in the spanning tree is included even if it shares too few points.
    """
    near = covisible(slam_map, keyframe_id, at_least)[0][:at_most]
    parent = slam_map.parent[slam_map.row(keyframe_id)]
    if parent != NONE and parent not in near:
        near = np.append(near[: at_most - 1], parent)
    ids = np.append(np.int64(keyframe_id), near)
    slam_map = slam_map.around(ids)
    return ids, distinct(slam_map.observations.point[has(np.sort(ids), slam_map.observations.keyframe)])[0]


def surviving_keyframes(slam_map: Map, keyframe_ids: Int[np.ndarray, " m"]) -> Int64[np.ndarray, " m"]:
    """Replace the id of each culled keyframe by the id of its anchor that is still in the map.

    Raises:
        KeyError: If a keyframe was never in this map.
    """
    order = np.argsort(slam_map.culled.ids)
    culled, anchor = slam_map.culled.ids[order], slam_map.culled.anchor[order]
    ids = np.array(keyframe_ids, np.int64)
    while (gone := ~has(slam_map.ids, ids)).any():
        ids[gone] = anchor[rows(culled, ids[gone])]
    return ids


def point_submaps(slam_map: Map) -> Int32[np.ndarray, " p"]:
    """Return the `(p,)` submap of each point: the submap of its reference keyframe."""
    makers, _ = distinct(slam_map.points.reference_keyframe)
    submaps = slam_map.submap[rows(slam_map.ids, surviving_keyframes(slam_map, makers))]
    return submaps[rows(makers, slam_map.points.reference_keyframe)]
