"""Local mapping: add a keyframe to the map, match and create points, adjust the local map, and cull.

It runs in the back end, in a thread or in turn with tracking, and is the only code that edits the map. The tracker
takes over each new map when it is ready, and moves its points along with the corrected keyframes.

Source: Mur-Artal et al., "ORB-SLAM", 2015, section VI, for the steps; Mur-Artal and Tardos, "ORB-SLAM2", 2017, section
III, for points with measured depth.
"""

import logging
from typing import NamedTuple

import cv2
import jax
import numpy as np
from jaxslam_kernels.camera import to_pixels
from jaxslam_kernels.types import Pixels, Weights
from jaxtyping import Array, Float, Float32, Int

from jaxslam.config.schema import Config, MappingConfig
from jaxslam.features.orb import FeaturePlan, Features, features_of
from jaxslam.geometry.se3 import compose, transform
from jaxslam.geometry.types import Ids, Pose
from jaxslam.loop_closing.loop_correction import with_loop_closed
from jaxslam.loop_closing.loop_detector import LoopClosure
from jaxslam.map.dynamic_removal import DynamicObservations, without_dynamic, without_dynamic_points
from jaxslam.map.edit import with_descriptors, with_keyframe, with_observations, with_points
from jaxslam.map.partial_map import PartialMap, extract_around, merge_back
from jaxslam.map.point_fusion import with_fused_points
from jaxslam.map.point_records import NONE, Observations, has, rows
from jaxslam.map.types import Keyframe, Map, covisible, empty_map, observers, point_submaps
from jaxslam.mapping.culling import (
    CONFIRM_WITHIN,
    within_memory,
    without_isolated,
    without_redundant,
    without_unconfirmed,
)
from jaxslam.mapping.global_bundle_adjustment import AdjustedSubmap, with_adjusted_submap
from jaxslam.mapping.local_bundle_adjustment import AdjustPlan, adjust_all, adjust_around, compile_adjustment
from jaxslam.mapping.local_map_tracking import LOCAL_KEYFRAMES, local_keyframes
from jaxslam.mapping.map_point_matching import (
    described_points_in,
    feature_observations,
    features_at,
    find_points,
    fuse_duplicates,
    points_of_features,
)
from jaxslam.mapping.occlusion_states import StateChanges, with_changes
from jaxslam.mapping.point_creation import new_points, with_triangulated
from jaxslam.mapping.track_table import TrackId, TrackTable
from jaxslam.runtime.compiled import compiled
from jaxslam.sensors.camera import Camera
from jaxslam.sensors.frame_arrays import FrameArrays
from jaxslam.sensors.measurement import pixel_rays
from jaxslam.sensors.sensor_model import SensorModel, depth_noise

_log = logging.getLogger(__name__)

_PART_KEYFRAMES = 30
"""Number of keyframes in the part of the map that a new keyframe may change."""
_FUSE_KEYFRAMES = 6
"""Number of neighbors with whose features the points of a new keyframe are matched to fuse duplicates."""
_JPEG = (cv2.IMWRITE_JPEG_QUALITY, 95)
"""How images of keyframes are compressed: 64 kB of 640x480 pixels in 0.7 ms, less than a gray value from what they
were. PNG leaves 121 kB and takes 10 ms; WebP without loss leaves 87 to 109 kB, but takes 160 ms."""
_LOOP_KEYFRAMES = 96
"""Number of keyframes around a loop that are adjusted when it is closed: there, covisible keyframes still disagree."""


class TrackedObservations(NamedTuple):
    """The points that the tracker observed in a keyframe.

    Attributes:
        id: `(n,)` tracker ids of the points (`TrackId`).
        uv_raw: `(2, n)` coordinates in the distorted image, pixels.
        X_cam: `(3, n)` positions in the camera frame, meters.
        weight: `(n,)` weights of the points, 0 to 1; 0 for a slot without a point.
    """

    id: Int[np.ndarray, " n"]
    uv_raw: Float32[np.ndarray, "2 n"]
    X_cam: Float32[np.ndarray, "3 n"]
    weight: Float32[np.ndarray, " n"]


class NewKeyframe(NamedTuple):
    """A frame that the tracker made a keyframe.

    Attributes:
        id: Id of the keyframe; ids arrive in order.
        timestamp_ns: Time of the image, nanoseconds.
        frame: The gray uint8 image, the depth image, and the mask of ignored pixels.
        parent: Id of its parent in the spanning tree; `NONE` for the first keyframe of a submap.
        T_parent_keyframe: `(7,)` pose relative to the parent; pose in the world if there is no parent.
        submap: Number of its submap.
        twist: `(6,)` velocity of the camera in its own axes, m/s, then rad/s.
        tracks: Points that the tracker observed.
        features: ORB features of the image; `None` if they are not extracted yet.
        states: States of map points that have changed since the previous keyframe; `None` without occlusion states.
    """

    id: int
    timestamp_ns: int
    frame: FrameArrays
    parent: int
    T_parent_keyframe: Pose
    submap: int
    twist: Float32[np.ndarray, "6"]
    tracks: TrackedObservations
    features: Features | None = None
    states: StateChanges | None = None


_SETTINGS = MappingConfig()  # the only place of defaults


class MappingPlan(NamedTuple):
    """Settings of local mapping.

    Attributes:
        features: Settings of feature extraction.
        adjust: Settings of local bundle adjustment.
        track_sigma_px: Standard deviation of the position of a point tracked by optical flow, pixels.
        search_px: Search radius around the projection of a map point at octave 0, pixels.
        max_mb: Memory that the map may take, megabytes; `None` without a limit.
        global_adjustment: Whether global bundle adjustment follows a loop, so that windows need not be adjusted.
    """

    features: FeaturePlan = FeaturePlan()
    adjust: AdjustPlan = AdjustPlan()
    track_sigma_px: float = _SETTINGS.track_sigma_px
    search_px: float = _SETTINGS.search_px
    max_mb: float | None = _SETTINGS.max_mb
    global_adjustment: bool = _SETTINGS.global_adjustment


def mapping_plan(camera: Camera, config: Config) -> MappingPlan:
    """Collect the settings of local mapping; the depth noise is the tracker's."""
    mapping, occlusion, noise = config.mapping, config.dynamics.occlusion, depth_noise(camera, config.track)
    return MappingPlan(
        features=FeaturePlan(
            num_features=mapping.num_features,
            num_levels=mapping.num_levels,
            scale_factor=mapping.scale_factor,
            fast_threshold=mapping.fast_threshold,
            min_fast_threshold=mapping.min_fast_threshold,
        ),
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
        max_mb=mapping.max_mb,
        global_adjustment=mapping.global_adjustment,
    )


class LocalMapping:
    """Builds the map from keyframes.

    Attributes:
        map: The latest map.
    """

    def __init__(self, camera: Camera, sensor: SensorModel, plan: MappingPlan, slam_map: Map | None = None) -> None:
        """Start with a map, empty by default."""
        self.map = (empty_map(camera) if slam_map is None else slam_map).in_blocks()
        self._sensor, self._plan = sensor, plan
        self._tracks = TrackTable()

    def compile(self, frame: FrameArrays, num_tracks: int) -> None:
        """Compile all programs of local mapping for frames of this size with `num_tracks` points."""
        twist = np.zeros(6, np.float32)
        features_of(frame, twist, self._sensor, self._plan.features)
        nothing = np.zeros((2, num_tracks), np.float32)
        jax.block_until_ready(_ideal(nothing, nothing[0], twist, frame, self._sensor))
        compile_adjustment(self._plan.adjust)

    def add(self, new: NewKeyframe) -> Map:
        """Add a keyframe to the map; return the new map. Section numbers are of ORB-SLAM (2015)."""
        # 1. Feature extraction, and keyframe insertion into the spanning tree (VI-A).
        features = new.features
        if features is None:
            features = features_of(new.frame, new.twist, self._sensor, self._plan.features)
        whole = with_new_keyframe(self.map, new, features)
        # 2. Extract the part of the map that the keyframe may change.
        known = self._tracks.points(new.tracks.id)
        part = _part(whole, new.id, known[whole.contents.have(known)])
        # 3. Observations of the points tracked by optical flow, which ORB-SLAM does not have, at features if there are.
        slam_map = self._with_tracks(part.map, new, known, features)
        # 4. Matching of the local map by descriptor (V-D), here with the keyframe only and not with every frame.
        slam_map = self._with_found_points(slam_map, new.id, features)
        # 5. New points: from measured depth (ORB-SLAM2, III), then triangulated with covisible keyframes (VI-C).
        slam_map = self._with_new_points(slam_map, new.id, features)
        near, _ = covisible(slam_map, new.id)
        near = near[has(part.keyframes, near)]
        slam_map = with_triangulated(slam_map, new.id, near, self._plan.features)
        # 6. Fusion of duplicate points.
        slam_map = self._fused(slam_map, new.id, near[:_FUSE_KEYFRAMES])
        # 7. Culling of recent map points (VI-B).
        slam_map = without_unconfirmed(slam_map, new.id)
        # 8. Local bundle adjustment (VI-D).
        slam_map = adjust_around(slam_map, new.id, self._plan.adjust, part.keyframes)
        # 9. Culling of redundant keyframes (VI-E).
        slam_map = without_redundant(slam_map, new.id, part.keyframes)
        # 10. Merge the changed part back into the map.
        self._tracks.forget(new.id)
        slam_map = without_isolated(merge_back(whole, part, slam_map), new.id)
        self.map = self._within_memory(slam_map, new.id)
        return self.map

    def take_states(self, changes: StateChanges) -> Map:
        """Apply changes of point states that came after the latest keyframe; return the new map."""
        self.map = with_changes(self.map, changes)
        return self.map

    def remove_points(self, point_ids: Ids) -> Map:
        """Remove points that are gone, those of them that are in the map; return the new map."""
        part = extract_around(self.map, point_ids[:0], point_ids[self.map.contents.have(point_ids)])
        self.map = merge_back(self.map, part, without_dynamic_points(part.map, point_ids))
        return self.map

    def close_loop(self, loop: LoopClosure) -> Map:
        """Close a loop, or merge two submaps; return the new map. Section numbers are of ORB-SLAM (2015)."""
        if not has(self.map.ids, np.array([loop.source, loop.target])).all():
            return self.map  # one of them has been culled since
        # 1. Correct the poses by the essential graph optimization (VII-D), or merge the submaps.
        whole = with_loop_closed(self.map, loop)
        # 2. Loop fusion (VII-C): fuse the points of the target with those of the source and its neighbors.
        part = extract_around(whole, _around_loop(whole, loop))
        near = covisible(part.map, loop.source)[0]
        near = near[has(part.keyframes, near) & (near != loop.target)][:LOCAL_KEYFRAMES]
        slam_map = self._fused(part.map, loop.target, np.append(np.int64(loop.source), near))
        # 3. Bundle adjustment of the target's local map. That of the whole map (ORB-SLAM2, 2017, III-D) comes later;
        #    without it, all keyframes around the loop are adjusted window by window.
        slam_map = adjust_around(slam_map, loop.target, self._plan.adjust, part.keyframes)
        if not self._plan.global_adjustment:
            slam_map = adjust_all(slam_map, self._plan.adjust, part.keyframes)
        self.map = merge_back(whole, part, slam_map)
        return self.map

    def take_adjusted(self, adjusted: AdjustedSubmap) -> Map:
        """Take over the result of global bundle adjustment; return the new map."""
        self.map = with_adjusted_submap(self.map, adjusted).in_blocks()
        return self.map

    def remove(self, movers: DynamicObservations) -> tuple[Map, Ids]:
        """Remove the dynamic features and points of a keyframe from the map.

        If the keyframe has been culled since, only the points that the tracker observed are known. Its other points are
        observed by the keyframes that made it redundant, and are removed with their masks.

        Returns:
            The new map, and the tracker ids of the removed points.
        """
        points = self._tracks.points(movers.tracks)
        present = np.array([movers.keyframe])
        present = present[has(self.map.ids, present)]
        part = extract_around(self.map, present, points[self.map.contents.have(points)])
        slam_map = without_dynamic(part.map, movers.keyframe, movers.mask) if len(present) else part.map
        slam_map = without_dynamic_points(slam_map, points)
        gone = part.map.points.ids[~has(slam_map.points.ids, part.map.points.ids)]
        self.map = merge_back(self.map, part, slam_map)
        tracks = self._tracks.tracks_of(gone)
        self._tracks.mark_removed(movers.tracks, movers.keyframe)
        return self.map, np.append(TrackId.of_map_points(gone), tracks)

    def _within_memory(self, slam_map: Map, keyframe_id: int) -> Map:
        """Drop keyframes if the map takes too much memory, and log how many."""
        if self._plan.max_mb is None:
            return slam_map
        small = within_memory(slam_map, keyframe_id, int(1e6 * self._plan.max_mb))
        if small is not slam_map:
            dropped = len(slam_map.ids) - len(small.ids)
            _log.info("the map takes %g MB (mapping.max_mb), keyframes that left it: %d", self._plan.max_mb, dropped)
        return small

    def _with_tracks(self, slam_map: Map, new: NewKeyframe, known: Ids, features: Features) -> Map:
        """Add the observations of tracked points; a track without a map point becomes a new point.

        A point where the keyframe has a feature takes its descriptor if it has none, so that it can be recognized.
        """
        tracks = new.tracks
        uv, depth = jax.device_get(
            _ideal(tracks.uv_raw, tracks.X_cam[2].astype(np.float32), new.twist, new.frame, self._sensor)
        )
        used = (tracks.weight > 0) & np.isfinite(uv).all(axis=0) & np.isfinite(tracks.X_cam).all(axis=0)
        fresh = np.flatnonzero(used & (known == NONE))
        _, first = np.unique(tracks.id[fresh], return_index=True)
        fresh = fresh[np.sort(first)]
        X_world = transform(slam_map.pose(new.id), tracks.X_cam[:, fresh].astype(np.float64))
        points = new_points(slam_map, new.id, X_world)
        slam_map = with_points(slam_map, points)
        known[fresh] = points.ids
        self._tracks.add(tracks.id[fresh], points.ids)
        self._tracks.observed(tracks.id[used], new.id)
        seen = np.flatnonzero(used & has(slam_map.points.ids, known))
        of_submap = (
            point_submaps(slam_map)[rows(slam_map.points.ids, known[seen])] == slam_map.submap[slam_map.row(new.id)]
        )
        seen = seen[of_submap]
        feature = features_at(features, tracks.uv_raw[:, seen])
        shown = feature != NONE
        slam_map = with_descriptors(slam_map, known[seen[shown]], features.descriptor[feature[shown]])
        return with_observations(
            slam_map,
            Observations(
                keyframe=np.full(len(seen), new.id, np.int64),
                point=known[seen],
                feature=feature,
                uv_raw=tracks.uv_raw[:, seen],
                uv=uv[:, seen],
                depth=depth[seen],
                sigma_px=np.full(len(seen), self._plan.track_sigma_px, np.float32),
                weight=tracks.weight[seen],
            ),
        )

    def _with_found_points(self, slam_map: Map, keyframe_id: int, features: Features) -> Map:
        """Match the points of the local map with a keyframe by descriptor, and fuse them with tracked points there."""
        plan = self._plan.features
        points = described_points_in(slam_map, local_keyframes(slam_map, keyframe_id), plan)
        seen = slam_map.observations.point[slam_map.observations.keyframe == keyframe_id]
        points = points.without(seen)
        index, feature = find_points(
            slam_map, points, features, slam_map.pose(keyframe_id), plan, radius_px=self._plan.search_px
        )
        found, there = points.ids[index], points_of_features(slam_map, keyframe_id, len(features.octave))[feature]
        free = there == NONE
        slam_map = with_observations(
            slam_map, feature_observations(keyframe_id, features, found[free], feature[free], plan)
        )
        drop, first = np.unique(np.maximum(found, there)[~free], return_index=True)
        keep = np.minimum(found, there)[~free][first]
        self._tracks.fuse(dict(zip(drop.tolist(), keep.tolist(), strict=True)))
        return with_fused_points(slam_map, keep, drop)

    def _with_new_points(self, slam_map: Map, keyframe_id: int, features: Features) -> Map:
        """Create a point for every feature with measured depth that shows no point yet."""
        taken = points_of_features(slam_map, keyframe_id, len(features.octave)) != NONE
        free = np.flatnonzero((features.depth > 0) & ~taken)
        uv, depth = features.uv[:, free].astype(np.float64), features.depth[free].astype(np.float64)
        X_cam = slam_map.camera.back_project(uv, depth)
        points = new_points(
            slam_map, keyframe_id, transform(slam_map.pose(keyframe_id), X_cam), features.descriptor[free]
        )
        return with_observations(
            with_points(slam_map, points),
            feature_observations(keyframe_id, features, points.ids, free, self._plan.features),
        )

    def _fused(self, slam_map: Map, keyframe_id: int, neighbors: Ids) -> Map:
        slam_map, keep, drop = fuse_duplicates(
            slam_map, keyframe_id, neighbors, self._plan.features, radius_px=self._plan.search_px
        )
        self._tracks.fuse(dict(zip(drop.tolist(), keep.tolist(), strict=True)))
        return slam_map


def with_new_keyframe(slam_map: Map, new: NewKeyframe, features: Features) -> Map:
    """Insert a keyframe without observations at its pose relative to its parent, and apply its changed point states."""
    if new.states is not None:
        slam_map = with_changes(slam_map, new.states)
    pose, parent, submap = new.T_parent_keyframe, new.parent, new.submap
    if parent != NONE:
        pose = compose(slam_map.pose(parent), pose)
        parent = slam_map.surviving_keyframe(parent)
        submap = int(slam_map.submap[slam_map.row(parent)])  # the submap may have been merged into another one
    encoded, jpeg = cv2.imencode(".jpg", np.asarray(new.frame.image), _JPEG)
    if not encoded:
        raise RuntimeError("the image of a keyframe could not be compressed")
    keyframe = Keyframe(new.id, new.timestamp_ns, features, jpeg.tobytes())
    return with_keyframe(slam_map, keyframe, pose, parent, submap)


@compiled(when="warm-up")
def _ideal(
    uv_raw: Pixels, expected_depth: Weights, twist: Float[Array, "6"], frame: FrameArrays, sensor: SensorModel
) -> tuple[Pixels, Weights]:
    """Convert pixels of the distorted image to pixels of the ideal camera, and measure their depth."""
    sensor = sensor.for_readout(frame.readout_sign)
    seen = pixel_rays(uv_raw, sensor).measured(expected_depth, twist, frame.depth, frame.depth_delay_s, sensor)
    return to_pixels(sensor.intrinsics, seen.xy), seen.depth


def _part(slam_map: Map, keyframe_id: int, known: Ids) -> PartialMap:
    """Extract the part of the map that a new keyframe may change, given the map points that the tracker observed."""
    latest = slam_map.ids[slam_map.ids >= keyframe_id - CONFIRM_WITHIN]
    near = np.concatenate([observers(slam_map, known)[0][:LOCAL_KEYFRAMES], latest])
    parent = slam_map.parent[slam_map.row(keyframe_id)]
    near = np.append(near, parent) if parent != NONE else near
    around = observers(slam_map, extract_around(slam_map, near).map.points.ids)[0][:_PART_KEYFRAMES]
    return extract_around(slam_map, np.concatenate([near, around]), known)


def _around_loop(slam_map: Map, loop: LoopClosure) -> Ids:
    """Return the keyframes nearest to a loop, in its submap."""
    inside = slam_map.ids[slam_map.submap == slam_map.submap[slam_map.row(loop.target)]]
    apart = np.linalg.norm(
        slam_map.T_world_cam[rows(slam_map.ids, inside), 4:] - slam_map.pose(loop.target)[4:], axis=1
    )
    near = inside[np.argsort(apart, kind="stable")[:_LOOP_KEYFRAMES]]
    return np.union1d(near, [loop.source, loop.target])
