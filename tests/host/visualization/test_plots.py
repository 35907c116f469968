"""Pictures of trajectories: that they are drawn, hold what they should, and need no screen."""

import matplotlib as mpl
import numpy as np
import pytest
from matplotlib import font_manager
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.image import imread
from recorded_figures import recorded_figures
from small_map import small_map

from jaxslam.errors import TrajectoryError
from jaxslam.trajectory.evaluation import evaluate
from jaxslam.trajectory.trajectory import Trajectory
from jaxslam.visualization import plots as visualize
from jaxslam.visualization.plots import plot_map, plot_trajectory, png

STEP_NS = 100_000_000


def make_trajectory(n=60, offset=0.0):
    angle = np.linspace(0, 6, n)
    poses = np.zeros((n, 7))
    poses[:, 0] = 1
    poses[:, 4:] = np.stack([2 * np.cos(angle), 0.1 * np.sin(3 * angle) + offset * angle, np.sin(angle)], axis=1)
    return Trajectory(STEP_NS * np.arange(n), poses)


@pytest.fixture
def figures(monkeypatch):
    """The figures that get drawn."""
    return recorded_figures(visualize, monkeypatch)


def test_draws_the_evaluated_path_and_its_errors(tmp_path, figures):
    estimate, reference = make_trajectory(offset=0.03).select(np.r_[0:20, 30:60]), make_trajectory()
    evaluation = evaluate(estimate, reference)
    plot_trajectory(estimate, reference, evaluation, tmp_path / "plot.png")
    path, errors = figures[0].axes[:2]
    assert (path.get_xlabel(), path.get_ylabel(), path.get_aspect()) == ("x [m]", "z [m]", 1.0)
    (segments,) = [c for c in path.collections if isinstance(c, LineCollection)]
    assert len(segments.get_segments()) == len(estimate) - 2  # one step bridges the loss
    colored = np.asarray(segments.get_array())
    np.testing.assert_allclose(colored[:19], (evaluation.errors_m[:19] + evaluation.errors_m[1:20]) / 2)
    assert path.get_legend().get_texts()[0].get_text() == "ground truth"
    assert len(errors.patches) == len(evaluation.lost_spans_ns) == 1
    assert errors.patches[0].get_x() == pytest.approx(1.9)
    assert figures[0].get_suptitle() == str(evaluation)
    picture = imread(tmp_path / "plot.png")
    assert picture.shape[0] > picture.shape[1] > 500
    assert picture[..., :3].std() > 0.05


def test_shades_sparse_poses_in_one_piece(tmp_path, figures):
    """Every fourth frame has a pose: no patch for each of the pieces between, which may be thousands."""
    reference = make_trajectory(61)
    estimate = reference.select(np.r_[0:60:4, 60])
    evaluation = evaluate(estimate, reference, frames_ns=reference.timestamps_ns)
    assert len(evaluation.lost_spans_ns) == 15
    plot_trajectory(estimate, reference, evaluation, tmp_path / "plot.png")
    (patch,) = figures[0].axes[1].patches
    assert (patch.get_x(), patch.get_x() + patch.get_width()) == pytest.approx((0, 6))


@pytest.mark.parametrize("with_reference", [True, False])
def test_draws_without_evaluation(tmp_path, figures, with_reference):
    estimate = make_trajectory()
    plot_trajectory(estimate, make_trajectory(offset=0.1) if with_reference else None, None, tmp_path / "plot.png")
    (axes,) = figures[0].axes
    labels = [text.get_text() for text in axes.get_legend().get_texts()]
    assert labels == ["ground truth"] * with_reference + ["estimate", "begin", "end"]
    np.testing.assert_allclose(axes.lines[with_reference].get_xdata(), estimate.positions[:, 0])


def test_draws_one_perfect_pose(tmp_path):
    one = make_trajectory(1)
    plot_trajectory(one, one, evaluate(one, one, "none"), tmp_path / "plot.png")
    plot_trajectory(one, None, evaluate(one, one, "none"), tmp_path / "plot.png")
    assert imread(tmp_path / "plot.png").size


HALF = 0.5**0.5


@pytest.mark.parametrize(
    ("wxyz", "views"),
    [
        # The world has the camera's own axes: y down, z ahead.
        ((1, 0, 0, 0), [("from above", "x", "z", False, False), ("from the right", "z", "y", False, True)]),
        # The camera stands on its head: the world's y is up for it, and z behind it.
        ((0, 1, 0, 0), [("from above", "x", "z", False, True), ("from the right", "z", "y", True, False)]),
        # z of the world is up, and the camera looks along y.
        ((HALF, -HALF, 0, 0), [("from behind", "x", "z", False, False), ("from the right", "y", "z", False, False)]),
    ],
)
def test_map_stands_upright(tmp_path, figures, wxyz, views):
    """Up is where the first keyframe has it, and what is ahead of it is at the top of a picture from above."""
    slam_map = small_map()
    slam_map = slam_map._replace(
        T_world_cam=np.concatenate([np.tile(wxyz, (len(slam_map.ids), 1)), slam_map.T_world_cam[:, 4:]], axis=1)
    )
    plot_map(slam_map, Trajectory(STEP_NS * np.arange(len(slam_map.ids)), slam_map.T_world_cam), tmp_path / "map.svg")
    assert (tmp_path / "map.svg").read_bytes().startswith(b"<?xml")
    drawn = [
        (axes.get_title(), axes.get_xlabel()[0], axes.get_ylabel()[0], axes.xaxis_inverted(), axes.yaxis_inverted())
        for axes in figures[0].axes[:2]
    ]
    assert drawn == views
    seen = np.concatenate([slam_map.points.X_world.T, slam_map.T_world_cam[:, 4:]])
    for axes in figures[0].axes[:2]:
        low, high = sorted(axes.get_ylim())
        values = seen[:, "xyz".index(axes.get_ylabel()[0])]
        assert low < values.min()
        assert high > values.max()


def test_fonts_of_matplotlib_are_found_whatever_its_list_holds(monkeypatch, caplog):
    """The list in the user's cache folder may have been made where Matplotlib's own fonts were out of reach."""
    known = font_manager.fontManager
    foreign = [font for font in known.ttflist if not font.fname.startswith(mpl.get_data_path())]
    monkeypatch.setattr(known, "ttflist", foreign)
    visualize._add_own_fonts.cache_clear()
    figure = Figure()
    figure.add_subplot().loglog([1, 1000], [1, 1000])
    with caplog.at_level("WARNING"):
        png(figure)
    assert not caplog.records
    assert "STIXGeneral" in {font.name for font in known.ttflist}


def test_refuses(tmp_path):
    trajectory = make_trajectory()
    with pytest.raises(TrajectoryError, match="nothing to plot"):
        plot_trajectory(trajectory.select(np.zeros(60, bool)), None, None, tmp_path / "plot.png")
    with pytest.raises(TrajectoryError, match="cannot be written"):
        plot_trajectory(trajectory, None, None, tmp_path / "missing" / "plot.png")
