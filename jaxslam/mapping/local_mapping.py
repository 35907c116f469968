"""What becomes of a new keyframe: features, points of the map found in it, new points, adjustment, culling.

Runs beside tracking, in a thread or in turn, and owns the map: nobody else makes a new one. The tracker gets the new
map when it is there, and moves what it tracks along with the keyframes.

Source: Mur-Artal and Tardos, "ORB-SLAM2", 2017, section III, for the order of things and for the rules of culling.
"""

from typing import NamedTuple

import cv2
import jax
import numpy as np
from jaxslam_kernels.camera import to_pixels
from jaxslam_kernels.depth.sampling import believable
from jaxslam_kernels.types import Pixels, Weights
from jaxtyping import Array, Float

from jaxslam.config.schema import Config
from jaxslam.features.orb import FeaturePlan, Features, features_of
from jaxslam.geometry.se3 import compose, transform
from jaxslam.loop_closing.loop_correction import with_loop_closed
from jaxslam.loop_closing.loop_detector import LoopClosure
from jaxslam.map.dynamic_removal import Movers, without_known, without_movers
from jaxslam.map.edit import with_keyframe, with_points, with_sightings
from jaxslam.map.partial_map import Part, most_shared, part_around, put_back
from jaxslam.map.types import NONE, Keyframe, Map, Sightings, covisible, empty_map, has, point_submaps, rows, standing
from jaxslam.mapping.culling import CONFIRM_WITHIN, without_redundant, without_unconfirmed
from jaxslam.mapping.local_bundle_adjustment import AdjustPlan, adjust_all, adjust_around, compile_adjustment
from jaxslam.mapping.local_map_tracking import LOCAL_KEYFRAMES, local_keyframes
from jaxslam.mapping.map_point_matching import feature_sightings, find_points, fuse_duplicates, recognisable_in
from jaxslam.mapping.occlusion_states import StateChanges, with_changes
from jaxslam.mapping.point_creation import new_points, with_triangulated
from jaxslam.runtime.trace_cache import traced_once
from jaxslam.sensors.camera import Camera
from jaxslam.sensors.frame_arrays import FrameArrays
from jaxslam.tracking.from_config import depth_noise
from jaxslam.tracking.measurement import observe
from jaxslam.tracking.state import TrackParams

_PART_KEYFRAMES = 30
"""Keyframes that mapping looks at and changes at all, for a new one."""
_FUSE_KEYFRAMES = 6
_LOOP_KEYFRAMES = 96
"""Keyframes around a loop that are adjusted when it is closed: where those that see the same do not yet agree."""
_SPAN = 64
"""Keyframes after which the number the tracker gave a point is forgotten."""
_GONE = -2
"""In place of a point of the map: none, and none is to be made."""


class Tracks(NamedTuple):
    """Points the tracker saw in a keyframe.

    Attributes:
        id: `(n,)` the tracker's numbers; of a point recalled from the map, `recalled_id` of its id.
        seen_uv: `(2, n)` pixels as seen.
        X_cam: `(3, n)` in the axes of the camera, metres.
        weight: `(n,)` 0 to 1; 0 for no point.
    """

    id: np.ndarray
    seen_uv: np.ndarray
    X_cam: np.ndarray
    weight: np.ndarray


class NewKeyframe(NamedTuple):
    """A frame the tracker kept.

    Attributes:
        id: Number of the keyframe; they come in order.
        timestamp_ns: Its time.
        frame: Image (grey, uint8), depth and what to ignore.
        parent: The keyframe it hangs on; `NONE` if it is the first of a submap.
        T_parent_keyframe: `(7,)` its pose seen from there; in the world without a parent.
        submap: Number of its submap.
        twist: `(6,)` velocity of the camera in its own axes.
        tracks: Points seen.
        features: Found in it, if that has been done.
        states: Of points, changed since the keyframe before.
    """

    id: int
    timestamp_ns: int
    frame: FrameArrays
    parent: int
    T_parent_keyframe: np.ndarray
    submap: int
    twist: np.ndarray
    tracks: Tracks
    features: Features | None = None
    states: StateChanges | None = None


class MappingPlan(NamedTuple):
    """Settings of local mapping, static.

    Attributes:
        features: How features are found.
        adjust: How windows are adjusted.
        track_sigma_px: Standard deviation of a point followed by flow, pixels.
        search_px: How far from where the pose puts a point a feature is sought.
    """

    features: FeaturePlan = FeaturePlan()
    adjust: AdjustPlan = AdjustPlan()
    track_sigma_px: float = 0.3
    search_px: float = 3.0


def mapping_plan(camera: Camera, config: Config) -> MappingPlan:
    """The settings of local mapping; depth is measured as well as in tracking."""
    mapping, occlusion, noise = config.mapping, config.dynamics.occlusion, depth_noise(camera, config.track)
    return MappingPlan(
        features=FeaturePlan(**{name: getattr(mapping, name) for name in FeaturePlan._fields}),
        adjust=AdjustPlan(
            window=mapping.window,
            max_steps=mapping.max_steps,
            loss_scale=config.track.loss_scale,
            depth_sigma_m=noise.sigma_m,
            depth_sigma_per_m2=noise.sigma_per_m2,
            occluded_weight=occlusion.weight if occlusion.enabled else 1.0,
        ),
        track_sigma_px=mapping.track_sigma_px,
        search_px=mapping.search_px,
    )


def recalled_id(point_ids: np.ndarray) -> np.ndarray:
    """The tracker's numbers for points of the map: negative, so that none is one of its own."""
    return -1 - point_ids


def point_ids(recalled: np.ndarray) -> np.ndarray:
    """The points of the map by the tracker's numbers of recalled ones."""
    return -1 - recalled


class LocalMapping:
    """Makes the map out of keyframes."""

    def __init__(self, camera: Camera, params: TrackParams, plan: MappingPlan, map: Map | None = None) -> None:
        """Start with a map, empty by default."""
        self.map = empty_map(camera) if map is None else map
        self._params, self._plan = params, plan
        self._point_of: dict[int, int] = {}
        self._last_seen: dict[int, int] = {}

    def compile(self, frame: FrameArrays, num_tracks: int) -> None:
        """Compile all that a keyframe needs, for frames of this size with so many tracks."""
        twist = np.zeros(6, np.float32)
        features_of(frame, twist, self._params, self._plan.features)
        nothing = np.zeros((2, num_tracks), np.float32)
        jax.block_until_ready(_ideal(nothing, nothing[0], twist, frame, self._params))
        compile_adjustment(self._plan.adjust)

    def add(self, new: NewKeyframe) -> Map:
        """Take in a keyframe; gives the new map."""
        features = new.features
        if features is None:
            features = features_of(new.frame, new.twist, self._params, self._plan.features)
        whole = with_new_keyframe(self.map, new, features)
        known = self._points(new.tracks.id)
        part = _part(whole, new.id, known[has(whole.points.ids, known)])
        map = self._with_tracks(part.map, new, known)
        map, taken = self._with_found_points(map, new.id, features)
        map = self._with_new_points(map, new.id, features, taken)
        near, _ = covisible(map, new.id)
        near = near[has(part.keyframes, near)]
        map = with_triangulated(map, new.id, near, self._plan.features)
        map = self._fused(map, new.id, near[:_FUSE_KEYFRAMES])
        map = without_unconfirmed(map, new.id)
        map = adjust_around(map, new.id, self._plan.adjust, part.keyframes)
        map = without_redundant(map, new.id, part.keyframes)
        self._forget(new.id)
        self.map = put_back(whole, part, map)
        return self.map

    def take_states(self, changes: StateChanges) -> Map:
        """Take in states of points that changed after the last keyframe; gives the new map."""
        self.map = with_changes(self.map, changes)
        return self.map

    def close_loop(self, loop: LoopClosure) -> Map:
        """Close a loop, or make one submap of two; gives the new map."""
        if not has(self.map.ids, np.array([loop.source, loop.target])).all():
            return self.map  # one of them has been culled since
        whole = with_loop_closed(self.map, loop)
        part = part_around(whole, _around_loop(whole, loop))
        near = covisible(part.map, loop.source)[0]
        near = near[has(part.keyframes, near) & (near != loop.target)][:LOCAL_KEYFRAMES]
        map = self._fused(part.map, loop.target, np.append(np.int64(loop.source), near))
        map = adjust_around(map, loop.target, self._plan.adjust, part.keyframes)
        self.map = put_back(whole, part, adjust_all(map, self._plan.adjust, part.keyframes))
        return self.map

    def remove(self, movers: Movers) -> tuple[Map, np.ndarray]:
        """Take what may move out of a keyframe and the map.

        Of a keyframe that has been culled since, only the points that the tracker saw are known. The others were seen
        by those that made it redundant, and leave with what may move in them.

        Returns:
            The map, and the tracker's numbers of the points that have left it.
        """
        before = map = self.map
        if has(map.ids, np.array([movers.keyframe]))[0]:
            map = without_movers(map, movers.keyframe, movers.mask)
        map = without_known(map, self._points(movers.tracks))
        self.map = map
        gone = before.points.ids[~has(map.points.ids, before.points.ids)]
        points = set(gone.tolist())
        tracks = [track for track, point in self._point_of.items() if point in points]
        for track in movers.tracks[movers.tracks >= 0].tolist():
            self._point_of.setdefault(track, _GONE)
            self._last_seen.setdefault(track, movers.keyframe)
        return map, np.append(recalled_id(gone), np.array(tracks, np.int64))

    def _with_tracks(self, map: Map, new: NewKeyframe, known: np.ndarray) -> Map:
        """The points the tracker saw: those the map has get a sighting, the others become points."""
        tracks = new.tracks
        uv, depth = jax.device_get(
            _ideal(tracks.seen_uv, tracks.X_cam[2].astype(np.float32), new.twist, new.frame, self._params)
        )
        used = (tracks.weight > 0) & np.isfinite(uv).all(axis=0) & np.isfinite(tracks.X_cam).all(axis=0)
        fresh = np.flatnonzero(used & (known == NONE))
        _, first = np.unique(tracks.id[fresh], return_index=True)
        fresh = fresh[np.sort(first)]
        X_world = transform(map.pose(new.id), tracks.X_cam[:, fresh].astype(np.float64))
        points = new_points(map, new.id, X_world)
        map = with_points(map, points)
        known[fresh] = points.ids
        self._point_of.update(zip(tracks.id[fresh].tolist(), points.ids.tolist(), strict=True))
        self._last_seen.update(dict.fromkeys(tracks.id[used].tolist(), new.id))
        seen = np.flatnonzero(used & has(map.points.ids, known))
        of_submap = point_submaps(map)[rows(map.points.ids, known[seen])] == map.submap[map.row(new.id)]
        seen = seen[of_submap]
        return with_sightings(
            map,
            Sightings(
                keyframe=np.full(len(seen), new.id, np.int64),
                point=known[seen],
                feature=np.full(len(seen), NONE, np.int32),
                seen_uv=tracks.seen_uv[:, seen],
                uv=uv[:, seen],
                depth=depth[seen],
                sigma_px=np.full(len(seen), self._plan.track_sigma_px, np.float32),
                weight=tracks.weight[seen],
            ),
        )

    def _points(self, tracks: np.ndarray) -> np.ndarray:
        """The points of the map by the tracker's numbers of them; `NONE` where one has not come up yet."""
        points = (-1 - track if track < 0 else self._point_of.get(track, NONE) for track in tracks.tolist())
        return np.fromiter(points, np.int64, len(tracks))

    def _with_found_points(self, map: Map, keyframe_id: int, features: Features) -> tuple[Map, np.ndarray]:
        """Points of the map that its neighbours see, found in it by their descriptor; and the features they are."""
        points = recognisable_in(map, local_keyframes(map, keyframe_id))
        plan = self._plan.features
        index, feature = find_points(map, points, features, map.pose(keyframe_id), plan, radius_px=self._plan.search_px)
        return with_sightings(map, feature_sightings(keyframe_id, features, points.ids[index], feature, plan)), feature

    def _with_new_points(self, map: Map, keyframe_id: int, features: Features, taken: np.ndarray) -> Map:
        """A point for every feature with depth that is none yet."""
        free = np.flatnonzero(features.depth > 0)
        free = free[~np.isin(free, taken)]
        camera, depth = map.camera, features.depth[free].astype(np.float64)
        u, v = features.uv[:, free].astype(np.float64)
        X_cam = np.stack([(u - camera.cx) / camera.fx * depth, (v - camera.cy) / camera.fy * depth, depth])
        points = new_points(map, keyframe_id, transform(map.pose(keyframe_id), X_cam), features.descriptor[free])
        return with_sightings(
            with_points(map, points), feature_sightings(keyframe_id, features, points.ids, free, self._plan.features)
        )

    def _fused(self, map: Map, keyframe_id: int, neighbours: np.ndarray) -> Map:
        map, keep, drop = fuse_duplicates(
            map, keyframe_id, neighbours, self._plan.features, radius_px=self._plan.search_px
        )
        into = dict(zip(drop.tolist(), keep.tolist(), strict=True))
        for track, point in self._point_of.items() if into else ():
            while point in into:
                point = into[point]  # noqa: PLW2901 - one may have become one with a third
            self._point_of[track] = point
        return map

    def _forget(self, keyframe_id: int) -> None:
        """Forget numbers of the tracker that have not come up for long."""
        old = [track for track, last in self._last_seen.items() if last < keyframe_id - _SPAN]
        for track in old:
            del self._last_seen[track]
            self._point_of.pop(track, None)


def with_new_keyframe(map: Map, new: NewKeyframe, features: Features) -> Map:
    """The map with a keyframe where its parent has it, and no point seen in it yet; and what came with it of others."""
    if new.states is not None:
        map = with_changes(map, new.states)
    pose, parent, submap = new.T_parent_keyframe, new.parent, new.submap
    if parent != NONE:
        pose = compose(map.pose(parent), pose)
        parent = int(standing(map, np.array([parent]))[0])
        submap = int(map.submap[map.row(parent)])  # which may have become part of another one
    encoded, png = cv2.imencode(".png", np.asarray(new.frame.image), [cv2.IMWRITE_PNG_COMPRESSION, 1])
    if not encoded:
        raise RuntimeError("the image of a keyframe could not be compressed")
    keyframe = Keyframe(new.id, new.timestamp_ns, features, png.tobytes())
    return with_keyframe(map, keyframe, pose, parent, submap)


@jax.jit
@traced_once
def _ideal(
    seen_uv: Pixels, expected_depth: Weights, twist: Float[Array, "6"], frame: FrameArrays, params: TrackParams
) -> tuple[Pixels, Weights]:
    """Pixels of the ideal camera, and depth."""
    believed = believable(frame.depth, params.min_depth_m, params.max_depth_m)
    seen = observe(seen_uv, expected_depth, twist, believed, frame.depth_delay_s, params)
    return to_pixels(params.intrinsics, seen.xy), seen.depth


def _part(map: Map, keyframe_id: int, known: np.ndarray) -> Part:
    """The part of a map that a new keyframe may change, given the points of it that the tracker saw."""
    latest = map.ids[map.ids >= keyframe_id - CONFIRM_WITHIN]
    near = np.concatenate([most_shared(map, known, LOCAL_KEYFRAMES), latest])
    parent = map.parent[map.row(keyframe_id)]
    near = np.append(near, parent) if parent != NONE else near
    around = most_shared(map, part_around(map, near).map.points.ids, _PART_KEYFRAMES)
    return part_around(map, np.concatenate([near, around]), known)


def _around_loop(map: Map, loop: LoopClosure) -> np.ndarray:
    """The keyframes nearest to a loop, of its submap."""
    inside = map.ids[map.submap == map.submap[map.row(loop.target)]]
    apart = np.linalg.norm(map.T_world_cam[rows(map.ids, inside), 4:] - map.pose(loop.target)[4:], axis=1)
    near = inside[np.argsort(apart, kind="stable")[:_LOOP_KEYFRAMES]]
    return np.union1d(near, [loop.source, loop.target])
