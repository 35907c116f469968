"""Octrees as the octomap library reads them, against our own cells."""

from pathlib import Path

import numpy as np
import pytest

from jaxslam.dense.occupancy import HIT, LEAST, MISS, MOST, Occupancy, occupancy
from jaxslam.dense.octomap_file import octree, write_bt, write_ot
from jaxslam.errors import MapFileError

pyoctomap = pytest.importorskip("pyoctomap")


@pytest.fixture(scope="module")
def cells() -> Occupancy:
    """What five views of a wavy wall say, from places half a meter apart."""
    v, u = np.mgrid[:60, :80]
    rays = np.stack([(u.ravel() - 40) / 68, (v.ravel() - 30) / 68]).astype(np.float32)
    depths = [(2 + 0.5 * np.sin(u / 10 + view)).astype(np.float32) for view in range(5)]
    depths[0][:20] = 0
    poses = np.tile([1.0, 0, 0, 0, 0, 0, 0], (5, 1))
    poses[:, 4] = 0.5 * np.arange(5) - 1
    return occupancy(depths, poses, rays, 0.05)


def _library(tree, points: np.ndarray) -> np.ndarray:
    """Log-odds that the library has at points; not a number where it knows nothing."""
    found = np.full(len(points), np.nan)
    for index, point in enumerate(points.tolist()):
        node = tree.search(point)
        try:
            found[index] = node.getLogOdds()
        except (AttributeError, pyoctomap.NullPointerException):
            continue
    return found


def _points(cells: Occupancy, count: int = 10_000) -> np.ndarray:
    """Random points in the box around what is known, and a little beyond."""
    low = (cells.first - 3) * cells.cell_m
    high = (cells.first + np.array(cells.log_odds.shape) + 3) * cells.cell_m
    return np.random.default_rng(0).uniform(low, high, (count, 3))


class TestReadByTheLibrary:
    def test_bt(self, cells: Occupancy, tmp_path: Path) -> None:
        write_bt(tmp_path / "map.bt", cells)
        tree = pyoctomap.OcTree(1.0)
        assert tree.readBinary(str(tmp_path / "map.bt"))
        assert tree.getResolution() == cells.cell_m
        assert tree.size() == tree.calcNumNodes()
        points = _points(cells)
        theirs, ours = _library(tree, points), cells.at(points)
        assert np.mean(np.isnan(theirs) == np.isnan(ours)) > 0.999
        known = ~np.isnan(theirs) & ~np.isnan(ours)
        assert known.sum() > 1000
        assert min(np.sum(ours[known] >= 0), np.sum(ours[known] < 0)) > 50
        assert np.mean((theirs >= 0)[known] == (ours >= 0)[known]) > 0.999

    def test_ot(self, cells: Occupancy, tmp_path: Path) -> None:
        write_ot(tmp_path / "map.ot", cells)
        tree = pyoctomap.OcTree(1.0).read(str(tmp_path / "map.ot"))
        assert tree.size() == tree.calcNumNodes()
        points = _points(cells)
        np.testing.assert_allclose(_library(tree, points), cells.at(points), atol=1e-5)

    def test_inner_nodes_have_the_greatest_value(self, cells: Occupancy, tmp_path: Path) -> None:
        write_ot(tmp_path / "map.ot", cells)
        tree = pyoctomap.OcTree(1.0).read(str(tmp_path / "map.ot"))
        assert tree.getRoot().getLogOdds() == pytest.approx(cells.log_odds[cells.known].max())


class TestOctree:
    def test_eight_alike_are_one(self) -> None:
        """A cube of 8x8x8 free cells, at a corner of the tree, is one node three levels up; with one occupied, not."""
        odds, known = np.full((8, 8, 8), MISS), np.ones((8, 8, 8), bool)
        cells = Occupancy(0.1, np.array([8, 16, -8]), odds, known)
        tree = octree(cells)
        assert tree.leaf.sum() == 1
        assert tree.level[tree.leaf] == 13
        odds[3, 4, 5] = HIT
        assert octree(cells).leaf.sum() == 3 * 7 + 1

    def test_each_node_before_its_children(self, cells: Occupancy) -> None:
        tree = octree(cells)
        assert tree.level[0] == 0
        assert np.all(np.diff(tree.level) <= 1)

    def test_nothing_known(self) -> None:
        none = Occupancy(0.1, np.zeros(3, np.int64), np.zeros((2, 2, 2), np.float32), np.zeros((2, 2, 2), bool))
        with pytest.raises(MapFileError, match="octree: expected cells that are known, got none"):
            octree(none)

    def test_too_far(self) -> None:
        far = Occupancy(0.1, np.array([40_000, 0, 0]), np.zeros((1, 1, 1), np.float32), np.ones((1, 1, 1), bool))
        with pytest.raises(MapFileError, match=r"at most 32768 cells of 0.1 m .* got some at 40000"):
            octree(far)

    def test_unwritable(self, cells: Occupancy, tmp_path: Path) -> None:
        with pytest.raises(MapFileError, match="cannot be written"):
            write_bt(tmp_path / "no" / "map.bt", cells)


class TestOccupancy:
    def test_a_wall(self) -> None:
        """Free up to the wall, occupied in it, unknown behind and beside; once for each image, up to the bounds."""
        rays = np.stack(np.meshgrid(np.linspace(-0.2, 0.2, 30), np.linspace(-0.2, 0.2, 30))).reshape(2, -1)
        wall, pose = np.full(900, 2.03, np.float32), np.array([1.0, 0, 0, 0, 0, 0, 0])
        for count in (1, 3, 20):
            cells = occupancy([wall] * count, np.tile(pose, (count, 1)), rays, 0.1)
            ahead = np.array([[0.01, 0.01, z] for z in (0.55, 1.55, 2.05, 2.15)])
            free, hit = max(count * MISS, LEAST), min(count * HIT, MOST)
            np.testing.assert_allclose(cells.at(ahead), np.array([free, free, hit, np.nan], np.float32), rtol=1e-5)
            assert np.isnan(cells.at(np.array([[1.5, 0.0, 1.0], [100.0, 0, 0]]))).all()

    def test_cells_become_larger(self) -> None:
        """A box of more than 67 million cells is not held."""
        rays, poses = np.zeros((2, 1), np.float32), np.tile([1.0, 0, 0, 0, 0, 0, 0], (2, 1))
        poses[1, 4:] = [40, 40, 20]
        assert occupancy([np.ones(1, np.float32)] * 2, poses, rays, 0.05).cell_m == 0.1

    def test_no_depth(self) -> None:
        with pytest.raises(MapFileError, match="octree: expected depth of at least one keyframe, got none"):
            occupancy([np.zeros(1, np.float32)], np.array([[1.0, 0, 0, 0, 0, 0, 0]]), np.zeros((2, 1)), 0.1)
