"""The table of the tracker's points: which map point each is."""

import numpy as np

from jaxslam.map.point_records import NONE
from jaxslam.mapping.track_table import REMOVED, TrackId, TrackTable


def ids(*values: int) -> np.ndarray:
    return np.array(values, np.int64)


class TestTrackId:
    def test_round_trip(self) -> None:
        points = np.arange(5)
        tracks = TrackId.of_map_points(points)
        assert TrackId.is_map_point(tracks).all()
        np.testing.assert_array_equal(TrackId.map_points(tracks), points)

    def test_own_points_are_not_map_points(self) -> None:
        assert not TrackId.is_map_point(ids(0, 1, 2**31 - 1)).any()


class TestTrackTable:
    def test_points(self) -> None:
        table = TrackTable()
        table.add(ids(7, 8), ids(100, 101))
        table.mark_removed(ids(8, 9, int(TrackId.of_map_points(ids(5))[0])), 0)
        tracks = np.append(ids(7, 8, 9, 10), TrackId.of_map_points(ids(0, 5)))
        assert table.points(tracks).tolist() == [100, 101, REMOVED, NONE, 0, 5]

    def test_tracks_of(self) -> None:
        table = TrackTable()
        table.add(ids(1, 2, 3), ids(10, 11, 10))
        assert sorted(table.tracks_of(ids(10, 12)).tolist()) == [1, 3]
        assert table.tracks_of(ids()).dtype == np.int64

    def test_fused_more_than_once(self) -> None:
        table = TrackTable()
        table.add(ids(1, 2, 3), ids(10, 11, 12))
        table.fuse({10: 11, 11: 12})
        assert table.points(ids(1, 2, 3)).tolist() == [12, 12, 12]

    def test_a_fused_map_point_that_is_tracked(self) -> None:
        """The tracker keeps the id that it got with a keyframe."""
        table, tracks = TrackTable(), TrackId.of_map_points(ids(10, 11))
        table.observed(tracks, 0)
        table.fuse({10: 11})
        table.fuse({11: 4})
        assert table.points(tracks).tolist() == [4, 4]
        assert sorted(table.tracks_of(ids(4)).tolist()) == sorted(tracks.tolist())
        table.forget(65)
        assert table.points(tracks).tolist() == [10, 11]

    def test_forgets_what_no_keyframe_observes(self) -> None:
        table = TrackTable()
        table.add(ids(1, 2), ids(10, 11))
        table.observed(ids(1, 2), 0)
        table.observed(ids(2), 30)
        table.mark_removed(ids(3), 0)
        table.forget(64)
        assert table.points(ids(1, 2, 3)).tolist() == [10, 11, REMOVED]
        table.forget(65)
        assert table.points(ids(1, 2, 3)).tolist() == [NONE, 11, NONE]
