"""The tracker's point ids: their codec, and a table from tracks to map points."""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Bool, Int, Int64

from jaxslam.map.point_records import NONE

REMOVED = -2
"""In place of a map point: the track was on a movable object; never make a map point of it."""
_SPAN = 64
"""Keyframes without an observation after which a track is forgotten."""


class TrackId:
    """Codec of the ids that the tracker gives to points.

    A point that the tracker detected itself has an id of 0 or more. A map point that it got with a reloaded keyframe
    has the negative id `-1 - point`, so that neither is mistaken for the other. It keeps that id while it is tracked,
    even if the map point is fused with another one.
    """

    @staticmethod
    def of_map_points(points: Int64[np.ndarray, " n"]) -> Int64[np.ndarray, " n"]:
        """Encode ids of map points."""
        return -1 - points

    @staticmethod
    def map_points(tracks: Int[np.ndarray, " n"]) -> Int[np.ndarray, " n"]:
        """Decode ids that `of_map_points` encoded."""
        return -1 - tracks

    @staticmethod
    def is_map_point(tracks: Int[np.ndarray, " n"]) -> Bool[np.ndarray, " n"]:
        """Tell which ids are of map points."""
        return tracks < 0


class TrackTable:
    """Map points by the tracker's ids, for the tracks observed in the latest keyframes."""

    def __init__(self) -> None:
        """Start with no tracks."""
        self._point_of: dict[int, int] = {}
        self._tracks_of: dict[int, set[int]] = {}
        """Tracks by their map point."""
        self._last_keyframe: dict[int, int] = {}
        self._latest = NONE

    def points(self, tracks: Int[np.ndarray, " n"]) -> Int64[np.ndarray, " n"]:
        """Look up the map points of tracks; `NONE` for a new track and `REMOVED` for one that must not become one."""
        unless_known = np.where(TrackId.is_map_point(tracks), TrackId.map_points(tracks), NONE)
        pairs = zip(tracks.tolist(), unless_known.tolist(), strict=True)
        return np.fromiter((self._point_of.get(track, point) for track, point in pairs), np.int64, len(tracks))

    def tracks_of(self, points: Int64[np.ndarray, " n"]) -> Int64[np.ndarray, " m"]:
        """List the tracks whose map point is one of `points`."""
        found = (sorted(self._tracks_of.get(point, ())) for point in points.tolist())
        return np.array([track for tracks in found for track in tracks], np.int64)

    def add(self, tracks: Int[np.ndarray, " n"], points: Int64[np.ndarray, " n"]) -> None:
        """Record that tracks have become map points."""
        for track, point in zip(tracks.tolist(), points.tolist(), strict=True):
            self._set(track, point)

    def observed(self, tracks: Int[np.ndarray, " n"], keyframe: int) -> None:
        """Record that tracks were observed in a keyframe."""
        self._latest = keyframe
        self._last_keyframe.update(dict.fromkeys(tracks.tolist(), keyframe))

    def mark_removed(self, tracks: Int[np.ndarray, " n"], keyframe: int) -> None:
        """Keep tracks that were on a movable object in a keyframe from becoming map points."""
        for track in tracks[~TrackId.is_map_point(tracks)].tolist():
            self._set_new(track, REMOVED)
            self._last_keyframe.setdefault(track, keyframe)

    def fuse(self, into: Mapping[int, int]) -> None:
        """Follow map points that were fused: each key of `into` has become its value, which may be a key as well."""
        gone = np.fromiter(into, np.int64, len(into))
        for track, point in zip(TrackId.of_map_points(gone).tolist(), gone.tolist(), strict=True):
            self._set_new(track, point)
            self._last_keyframe.setdefault(track, self._latest)
        for point in into:
            last = point
            while last in into:  # what it was fused with may have been fused with a third
                last = into[last]
            for track in tuple(self._tracks_of.get(point, ())):
                self._set(track, last)

    def forget(self, keyframe: int) -> None:
        """Forget tracks that have not been observed in the last 64 keyframes before `keyframe`."""
        old = [track for track, last in self._last_keyframe.items() if last < keyframe - _SPAN]
        for track in old:
            del self._last_keyframe[track]
            self._set(track, None)

    def _set_new(self, track: int, point: int) -> None:
        """Note the map point of a track that has none."""
        if track not in self._point_of:
            self._set(track, point)

    def _set(self, track: int, point: int | None) -> None:
        """Note the map point of a track; `None` to forget the track."""
        before = self._point_of.pop(track, None)
        if before is not None:
            self._tracks_of[before].remove(track)
            if not self._tracks_of[before]:
                del self._tracks_of[before]
        if point is not None:
            self._point_of[track] = point
            self._tracks_of.setdefault(point, set()).add(track)
