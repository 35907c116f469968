"""Every figure that evo has too is evo's to 1e-6, in its own unit, on six real trajectories.

Three are estimates of other systems, three are ours of the first frames of recordings. `pytest -n 0 -s` on this file
prints the figures as a Markdown table.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from evo_figures import Evo

from jaxslam.config.loading import load_config
from jaxslam.datasets import Subset, open_dataset
from jaxslam.sensors.camera import Camera
from jaxslam.slam.slam import Slam
from jaxslam.trajectory.evaluation import AlignmentKind, evaluate
from jaxslam.trajectory.trajectory import Trajectory, associate, read

FRAMES = 50
MOST_POSES = 1200
"""Of a file: evo checks every pose it is given, which takes 5 seconds for the 4,541 of KITTI 00."""
FILES = {
    "fr1_xyz, RGBD-SLAM": ("freiburg1_xyz-rgbdslam.txt", "freiburg1_xyz-groundtruth.txt"),
    "fr2_desk, ORB": ("fr2_desk_ORB.txt", "fr2_desk_groundtruth.txt"),
    "KITTI 00, ORB": ("KITTI_00_ORB.txt", "KITTI_00_gt.txt"),
}
RUNS = {
    "fr1_rpy, ours": ("tum/rgbd_dataset_freiburg1_rpy_excerpt", None),
    "Bonn crowd, ours": ("bonn/rgbd_bonn_crowd", None),
    "kitchen, ours": (
        "composite/kitchen_people",
        Camera("kitchen", 640, 480, 545, 545, 320, 240, depth_scale_per_m=5000),
    ),
}


class Pair(NamedTuple):
    """An estimate and the truth."""

    name: str
    estimate: Trajectory
    reference: Trajectory

    def matched(self) -> tuple[Trajectory, Trajectory]:
        """The poses at the same times."""
        index = associate(self.estimate.timestamps_ns, self.reference.timestamps_ns)
        return self.estimate.select(index[0]), self.reference.select(index[1])


class Row(NamedTuple):
    """A figure of both."""

    trajectory: str
    align: str
    figure: str
    ours: float
    evo: float


@pytest.fixture(scope="module")
def table() -> Iterator[list[Row]]:
    """What has been compared; it is printed in the end."""
    rows: list[Row] = []
    yield rows
    print("\n\n| trajectory | aligned | figure | ours | evo | difference |\n|---|---|---|---|---|---|")
    for *names, ours, evo in rows:
        print(f"| {' | '.join(names)} | {ours:.9f} | {evo:.9f} | {abs(ours - evo):.1e} |")


@pytest.fixture(scope="module", params=[*FILES, *(pytest.param(name, marks=pytest.mark.slow) for name in RUNS)])
def pair(request: pytest.FixtureRequest, data_dir: Path) -> Pair:
    name = request.param
    if name in FILES:
        estimate, reference = (read(data_dir / "trajectories" / file) for file in FILES[name])
        some = np.arange(0, len(estimate), -(-len(estimate) // MOST_POSES))
        return Pair(name, estimate.select(some), reference)
    path, camera = RUNS[name]
    dataset = Subset(open_dataset(data_dir / path, camera=camera), 0, FRAMES)
    with Slam(dataset.camera, load_config("static", overrides=["semantics.model=null"])) as slam:
        slam.run(dataset)
        assert len(slam.trajectory) > 0.8 * FRAMES
        assert dataset.ground_truth is not None
        return Pair(name, slam.trajectory, dataset.ground_truth)


def one_second_apart(stamps_ns: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Each pose, the first at least a second later, and the seconds between them."""
    later = ((i, np.flatnonzero(stamps_ns >= stamp + 10**9)) for i, stamp in enumerate(stamps_ns))
    pairs = np.array([(i, found[0]) for i, found in later if len(found)])
    return pairs[:, 0], pairs[:, 1], np.diff(stamps_ns[pairs])[:, 0] / 1e9


def figures_of_evo(estimate: Trajectory, reference: Trajectory, align: AlignmentKind) -> dict[str, float]:
    """Figures of matched poses under the names they have in an `Evaluation`."""
    evo = Evo(estimate, reference, align)
    meters_per_s, degrees_per_s = evo.rpe_of(*one_second_apart(estimate.timestamps_ns))
    ate = evo.ate()
    return {
        **{f"ate_{name}_m": ate[name] for name in ("rmse", "mean", "median", "max", "std")},
        "scale": evo.scale,
        "rpe_trans_m_per_s": meters_per_s,
        "rpe_rot_deg_per_s": degrees_per_s,
        "rpe_trans_m_per_frame": evo.rpe("translation_part"),
        "rpe_rot_deg_per_frame": evo.rpe("rotation_angle_deg"),
    }


@pytest.mark.parametrize("align", ["none", "se3", "sim3"])
def test_equals_evo(pair: Pair, align: AlignmentKind, table: list[Row]) -> None:
    ours = evaluate(pair.estimate, pair.reference, align)
    theirs = figures_of_evo(*pair.matched(), align)
    rows = [Row(pair.name, align, name, getattr(ours, name), value) for name, value in theirs.items()]
    table += rows
    for row in rows:
        assert row.ours == pytest.approx(row.evo, abs=1e-6), row.figure
    if align == "sim3":
        assert ours.ate_sim3_rmse_m == ours.ate_rmse_m
        assert ours.sim3_scale == ours.scale
