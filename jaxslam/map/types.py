"""The map: keyframes, points, and which keyframe saw which point where.

Immutable: a change makes a new `Map` that shares all that did not change. Whoever holds one reads it without locks
and without waiting, whatever other threads do. Rows are sorted by id, and an id is never given twice.

Arrays are NumPy's and as long as needed; what the kernels get is cut out and padded to a few sizes where it is used.
"""

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int8, Int32, Int64, UInt8

from jaxslam.features.orb import DESCRIPTOR_BYTES, Features
from jaxslam.geometry.se3 import IDENTITY, compose
from jaxslam.sensors.camera import Camera

if TYPE_CHECKING:
    from scipy.sparse import csr_array

NONE = -1
"""No keyframe, no point, no feature."""


class Keyframe(NamedTuple):
    """What was seen from one place; nothing of it changes, but features may leave it.

    Attributes:
        id: Its number.
        timestamp_ns: Its time, nanoseconds.
        features: What can be recognized in it.
        image_png: The gray image, losslessly compressed.
    """

    id: int
    timestamp_ns: int
    features: Features
    image_png: bytes


class MapPoints(NamedTuple):
    """Points of the world, one a row.

    Attributes:
        ids: Ascending.
        X_world: Meters.
        weight: How much each counts, 0 to 1.
        descriptor: ORB descriptor of the points that can be recognized, zeros for the others.
        recognizable: Which have a descriptor; the others are only followed and looked up by their picture.
        reference_keyframe: Id of the keyframe that made each.
        state: A `PointState` of each: whether something that moves has passed before it.
    """

    ids: Int64[np.ndarray, " p"]
    X_world: Float64[np.ndarray, "3 p"]
    weight: Float32[np.ndarray, " p"]
    descriptor: UInt8[np.ndarray, "p 32"]
    has_descriptor: Bool[np.ndarray, " p"]
    reference_keyframe: Int64[np.ndarray, " p"]
    state: Int8[np.ndarray, " p"]


class Observations(NamedTuple):
    """Which keyframe saw which point where; a keyframe sees a point at most once.

    Attributes:
        keyframe: Ids.
        point: Ids.
        feature: Index among the features of the keyframe; `NONE` for a point that was followed by optical flow.
        uv_raw: As seen, pixels of the distorted image.
        uv: As an ideal pinhole camera without distortion and rolling shutter would have seen it, pixels.
        depth: Meters, 0 where there was none to believe.
        sigma_px: Standard deviation of `uv`, pixels.
        weight: How much each counts, 0 to 1.
    """

    keyframe: Int64[np.ndarray, " s"]
    point: Int64[np.ndarray, " s"]
    feature: Int32[np.ndarray, " s"]
    uv_raw: Float32[np.ndarray, "2 s"]
    uv: Float32[np.ndarray, "2 s"]
    depth: Float32[np.ndarray, " s"]
    sigma_px: Float32[np.ndarray, " s"]
    weight: Float32[np.ndarray, " s"]


class Loops(NamedTuple):
    """Relative poses measured where a place was recognized.

    Attributes:
        source: Ids of the keyframes in whose frame was measured.
        target: Ids of the keyframes that were measured.
        T_source_target: `wxyz_xyz`.
        information: Inverse covariances, tangent translation first.
    """

    source: Int64[np.ndarray, " l"]
    target: Int64[np.ndarray, " l"]
    T_source_target: Float64[np.ndarray, "l 7"]
    information: Float64[np.ndarray, "l 6 6"]


class Culled(NamedTuple):
    """Keyframes that were dropped, held by their place relative to another one, for the trajectory.

    Attributes:
        ids: In the order in which they were dropped.
        anchor: Ids of the keyframes they are held by, which may have been culled later.
        T_anchor_keyframe: `wxyz_xyz`.
    """

    ids: Int64[np.ndarray, " c"]
    anchor: Int64[np.ndarray, " c"]
    T_anchor_keyframe: Float64[np.ndarray, "c 7"]


class Map(NamedTuple):
    """All that is known of the world at one time.

    Attributes:
        camera: That made it.
        keyframes: Ascending by id.
        ids: `(k,)` their ids.
        T_world_cam: `(k, 7)` their poses, `wxyz_xyz`.
        parent: `(k,)` id of each one's parent in the spanning tree; `NONE` for the first of a submap.
        submap: `(k,)` number of the submap each belongs to; those of one submap share a world frame.
        points: The points.
        observations: Who saw what.
        loops: Loops closed so far.
        culled: Keyframes dropped so far.
        next_keyframe: The next id of a keyframe.
        next_point: The next id of a point.
    """

    camera: Camera
    keyframes: tuple[Keyframe, ...]
    ids: Int64[np.ndarray, " k"]
    T_world_cam: Float64[np.ndarray, "k 7"]
    parent: Int64[np.ndarray, " k"]
    submap: Int32[np.ndarray, " k"]
    points: MapPoints
    observations: Observations
    loops: Loops
    culled: Culled
    next_keyframe: int
    next_point: int

    @property
    def world_submap(self) -> int:
        """Number of the submap whose frame is the map's own: the earliest, into which the others are carried."""
        return int(self.submap.min()) if len(self.submap) else 0

    def row(self, keyframe_id: int) -> int:
        """Row of a keyframe that is in the map."""
        return int(rows(self.ids, np.array([keyframe_id]))[0])

    def keyframe(self, keyframe_id: int) -> Keyframe:
        """A keyframe that is in the map."""
        return self.keyframes[self.row(keyframe_id)]

    def pose(self, keyframe_id: int) -> np.ndarray:
        """`(7,)` pose `T_world_cam` of a keyframe, also of one that was culled."""
        T_anchor_keyframe = IDENTITY
        while not has(self.ids, np.array([keyframe_id]))[0]:
            found = np.flatnonzero(self.culled.ids == keyframe_id)
            if not len(found):
                raise KeyError(f"keyframe {keyframe_id} was never in this map")
            T_anchor_keyframe = compose(self.culled.T_anchor_keyframe[found[0]], T_anchor_keyframe)
            keyframe_id = int(self.culled.anchor[found[0]])
        return compose(self.T_world_cam[self.row(keyframe_id)], T_anchor_keyframe)


def empty_map(camera: Camera) -> Map:
    """A map of nothing."""
    none = np.zeros(0, np.int64)
    return Map(
        camera=camera,
        keyframes=(),
        ids=none,
        T_world_cam=np.zeros((0, 7)),
        parent=none,
        submap=np.zeros(0, np.int32),
        points=empty_points(),
        observations=empty_observations(),
        loops=Loops(none, none, np.zeros((0, 7)), np.zeros((0, 6, 6))),
        culled=Culled(none, none, np.zeros((0, 7))),
        next_keyframe=0,
        next_point=0,
    )


def empty_points() -> MapPoints:
    """No points."""
    return MapPoints(
        ids=np.zeros(0, np.int64),
        X_world=np.zeros((3, 0)),
        weight=np.zeros(0, np.float32),
        descriptor=np.zeros((0, DESCRIPTOR_BYTES), np.uint8),
        has_descriptor=np.zeros(0, bool),
        reference_keyframe=np.zeros(0, np.int64),
        state=np.zeros(0, np.int8),
    )


def empty_observations() -> Observations:
    """No observations."""
    return Observations(
        keyframe=np.zeros(0, np.int64),
        point=np.zeros(0, np.int64),
        feature=np.zeros(0, np.int32),
        uv_raw=np.zeros((2, 0), np.float32),
        uv=np.zeros((2, 0), np.float32),
        depth=np.zeros(0, np.float32),
        sigma_px=np.zeros(0, np.float32),
        weight=np.zeros(0, np.float32),
    )


def has(ids: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Which of the wanted ids are among the ascending `ids`."""
    if not len(ids):
        return np.zeros(len(wanted), bool)
    return ids[np.minimum(np.searchsorted(ids, wanted), len(ids) - 1)] == wanted


def rows(ids: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Where each of the wanted ids is among the ascending `ids`.

    Raises:
        KeyError: If one is not there.
    """
    known = has(ids, wanted)
    if not known.all():
        raise KeyError(f"not in the map: {wanted[~known][:8].tolist()}")
    return np.searchsorted(ids, wanted)


def visibility(slam_map: Map) -> "csr_array":
    """`(k, p)` matrix of ones where a keyframe saw a point, rows and columns as in the map."""
    from scipy.sparse import csr_array  # noqa: PLC0415 - see `late_imports`

    at = (rows(slam_map.ids, slam_map.observations.keyframe), rows(slam_map.points.ids, slam_map.observations.point))
    return csr_array((np.ones(len(at[0]), np.int32), at), shape=(len(slam_map.ids), len(slam_map.points.ids)))


def covisible(slam_map: Map, keyframe_id: int, at_least: int = 15) -> tuple[np.ndarray, np.ndarray]:
    """The keyframes that saw the same points as one of them: the covisibility graph around it.

    Args:
        slam_map: The map.
        keyframe_id: A keyframe in it.
        at_least: Fewest points in common.

    Returns:
        Ids, most points in common first, and how many they are; without the keyframe itself.
    """
    mine = np.unique(slam_map.observations.point[slam_map.observations.keyframe == keyframe_id])
    others = slam_map.observations.keyframe[has(mine, slam_map.observations.point)]
    ids, counts = np.unique(others[others != keyframe_id], return_counts=True)
    order = np.lexsort((-ids, -counts))
    order = order[counts[order] >= at_least]
    return ids[order], counts[order]


def neighborhood(
    slam_map: Map, keyframe_id: int, at_least: int = 15, at_most: int = 20
) -> tuple[np.ndarray, np.ndarray]:
    """The part of the map around a keyframe: what is matched and adjusted together.

    Args:
        slam_map: The map.
        keyframe_id: A keyframe in it.
        at_least: Fewest points in common with it.
        at_most: Most keyframes besides it.

    Returns:
        Ids of the keyframe, then of those that share most points with it; and, ascending, of the points that they saw.
        Its parent in the spanning tree comes along even if it shares too few.
    """
    near = covisible(slam_map, keyframe_id, at_least)[0][:at_most]
    parent = slam_map.parent[slam_map.row(keyframe_id)]
    if parent != NONE and parent not in near:
        near = np.append(near[: at_most - 1], parent)
    ids = np.append(np.int64(keyframe_id), near)
    return ids, np.unique(slam_map.observations.point[np.isin(slam_map.observations.keyframe, ids)])


def surviving_keyframes(slam_map: Map, keyframe_ids: np.ndarray) -> np.ndarray:
    """For each keyframe its own id, or for one that was culled, of the keyframe in the map that holds its place.

    Raises:
        KeyError: If one was never in this map.
    """
    order = np.argsort(slam_map.culled.ids)
    culled, anchor = slam_map.culled.ids[order], slam_map.culled.anchor[order]
    ids = np.array(keyframe_ids, np.int64)
    while (gone := ~has(slam_map.ids, ids)).any():
        ids[gone] = anchor[rows(culled, ids[gone])]
    return ids


def point_submaps(slam_map: Map) -> np.ndarray:
    """`(p,)` submap of each point: that of the keyframe that made it."""
    makers, which = np.unique(slam_map.points.reference_keyframe, return_inverse=True)
    return slam_map.submap[rows(slam_map.ids, surviving_keyframes(slam_map, makers))][which]


def points_at(points: MapPoints, index: np.ndarray) -> MapPoints:
    """The points in these rows, or where this mask is true."""
    columns = {name: array[index] for name, array in points._asdict().items() if name != "X_world"}
    return MapPoints(X_world=points.X_world[:, index], **columns)


def observations_at(observations: Observations, index: np.ndarray) -> Observations:
    """The observations in these rows, or where this mask is true."""
    return Observations(*(array[..., index] for array in observations))
