"""Pictures of trajectories: that they are drawn, hold what they should, and need no screen."""

import numpy as np
import pytest
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.image import imread

from jaxslam import visualize
from jaxslam.errors import TrajectoryError
from jaxslam.evaluation import evaluate
from jaxslam.trajectory import Trajectory
from jaxslam.visualize import plot_trajectory

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
    drawn = []

    class Recorded(Figure):
        def __init__(self, *args, **kwargs):
            super().__init__(*args, **kwargs)
            drawn.append(self)

    monkeypatch.setattr(visualize, "Figure", Recorded)
    return drawn


def test_draws_the_evaluated_path_and_its_errors(tmp_path, figures):
    estimate, reference = make_trajectory(offset=0.03).select(np.r_[0:20, 30:60]), make_trajectory()
    evaluation = evaluate(estimate, reference)
    plot_trajectory(estimate, reference, evaluation, tmp_path / "plot.png")
    path, errors = figures[0].axes[:2]
    assert (path.get_xlabel(), path.get_ylabel(), path.get_aspect()) == ("x [m]", "z [m]", 1.0)
    (segments,) = [c for c in path.collections if isinstance(c, LineCollection)]
    assert len(segments.get_segments()) == len(estimate) - 2  # one step bridges the loss
    coloured = np.asarray(segments.get_array())
    np.testing.assert_allclose(coloured[:19], (evaluation.errors_m[:19] + evaluation.errors_m[1:20]) / 2)
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


def test_refuses(tmp_path):
    trajectory = make_trajectory()
    with pytest.raises(TrajectoryError, match="nothing to plot"):
        plot_trajectory(trajectory.select(np.zeros(60, bool)), None, None, tmp_path / "plot.png")
    with pytest.raises(TrajectoryError, match="cannot be written"):
        plot_trajectory(trajectory, None, None, tmp_path / "missing" / "plot.png")
