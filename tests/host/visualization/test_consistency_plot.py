"""Picture of errors and covariances."""

from pathlib import Path

import numpy as np
import pytest
from matplotlib.image import imread
from recorded_figures import recorded_figures

from jaxslam.errors import TrajectoryError
from jaxslam.trajectory.consistency import Consistency
from jaxslam.visualization import consistency_plot
from jaxslam.visualization.consistency_plot import plot_consistency

SECONDS = np.r_[0:20, 60:100] / 30
CONSISTENCY = Consistency(
    num_poses=60,
    nees=1.5,
    nees_translation=1.0,
    nees_rotation=2.0,
    beyond_5_sigma_percent=0.0,
    timestamps_ns=(1e9 * SECONDS).astype(np.int64),
    nees_of_pose=1.5 + np.sin(SECONDS),
    translation_error_m=0.002 + 0.001 * np.cos(SECONDS),
    translation_sigma_m=np.full(60, 0.003),
    rotation_error_deg=0.02 + 0.01 * np.cos(SECONDS),
    rotation_sigma_deg=np.full(60, 0.03),
)


def test_draws_errors_and_deviations(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    drawn = recorded_figures(consistency_plot, monkeypatch)
    plot_consistency(CONSISTENCY, tmp_path / "consistency.png", title="a run")
    translation, rotation, nees = drawn[0].axes
    labels = [axes.get_ylabel() for axes in (translation, rotation, nees)]
    assert labels == ["translation [mm]", "rotation [deg]", "NEES"]
    errors = np.asarray(translation.lines[0].get_ydata(), float)
    assert np.isnan(errors).sum() == 1  # over the second in which there are no poses
    np.testing.assert_allclose(errors[~np.isnan(errors)], 1e3 * CONSISTENCY.translation_error_m)
    assert len(translation.collections) == len(rotation.collections) == 2
    assert drawn[0].get_suptitle() == f"a run\n{CONSISTENCY}"
    assert imread(tmp_path / "consistency.png")[..., :3].std() > 0.05


def test_refuses(tmp_path: Path) -> None:
    with pytest.raises(TrajectoryError, match="consistency"):
        plot_consistency(CONSISTENCY, tmp_path / "none" / "consistency.png")
