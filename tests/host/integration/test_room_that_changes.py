"""A room that is seen twice, and meanwhile a chair was moved: what is not there anymore leaves the map."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import yaml

from jaxslam import Slam, load_config
from jaxslam.geometry.se3 import compose, inverse, transform
from jaxslam.geometry.types import Pose
from jaxslam.map.types import Map
from jaxslam.slam.frame_result import FrameResult, Rejected
from jaxslam.tracking.state import KeyframeReason, TrackStatus
from jaxslam.trajectory.evaluation import evaluate
from jaxslam.worlds.library import load_world
from jaxslam.worlds.stored_world import StoredWorld

ROOT = Path(__file__).resolve().parents[3]
CHANGE_S = 24.0
CHAIR_M = 0.6, -0.9
REACH_M, FLOOR_M, TOP_M = 0.36, 0.06, 1.1
"""Radius and heights of the space of the chair, without the floor."""
NUM_OF_CHAIR = 60
"""Number of points below which the test would say little."""


def recording(tmp_path, changes: bool) -> StoredWorld:
    """The world `changes` in small images, by the light of its first half; or with all things where they were."""
    about = yaml.safe_load((ROOT / "configs/worlds/changes.yaml").read_text())
    del about["light_changes"]
    if not changes:
        about["things"] = [thing for thing in about["things"] if "from_s" not in thing]
        for thing in about["things"]:
            thing.pop("until_s", None)
    path = tmp_path / f"changes_{changes}.yaml"
    path.write_text(yaml.safe_dump(about))
    world = load_world(str(path))
    return StoredWorld(dataclasses.replace(world, camera=dataclasses.replace(world.camera, width=320, height=240)))


class Visits:
    """Tracks the recording, and keeps which points were where the chair was, at the change and at the end."""

    def __init__(self, dataset: StoredWorld, seed: int) -> None:
        truth, start_ns = dataset.ground_truth, dataset.timestamps_ns[0]
        assert truth is not None
        self.before: set[int] = set()
        with Slam(dataset.camera, load_config(overrides=[f"run.seed={seed}"])) as slam:
            first = None

            def on_frame(frame: object, result: FrameResult | Rejected) -> None:
                nonlocal first
                assert isinstance(result, FrameResult)
                first = result.T_world_cam if first is None else first
                if not self.before and result.timestamp_ns - start_ns >= CHANGE_S * 1e9:
                    self.before = of_chair(slam.map, compose(truth.T_world_cam[0], inverse(first)))

            records = slam.run(dataset, on_frame)
            self.num_lost = sum(record.status == TrackStatus.LOST for record in records)
            self.reasons = [record.keyframe for record in records]
            self.after = of_chair(slam.map, compose(truth.T_world_cam[0], inverse(np.asarray(first))))
            self.ate_m = evaluate(slam.trajectory, truth).ate_rmse_m


def of_chair(slam_map: Map, T_true_map: Pose) -> set[int]:
    """Ids of the points where the chair was."""
    X = transform(T_true_map, slam_map.points.X_world)
    apart = np.hypot(X[0] - CHAIR_M[0], X[1] - CHAIR_M[1])
    return set(slam_map.points.ids[(apart < REACH_M) & (X[2] > FLOOR_M) & (X[2] < TOP_M)].tolist())


@pytest.mark.slow
def test_points_of_a_chair_that_was_moved_leave_the_map(tmp_path) -> None:
    """Errors are compared over seeds: their ratio of one seed is 0.89 to 1.16."""
    errors = []
    for seed in range(3):
        same, moved = (Visits(recording(tmp_path, changes), seed) for changes in (False, True))
        assert min(len(same.before), len(moved.before)) >= NUM_OF_CHAIR
        assert len(same.before & same.after) >= 0.95 * len(same.before), "points of a chair that stands there stay"
        assert len(moved.before & moved.after) <= 0.05 * len(moved.before)
        assert KeyframeReason.CHANGED not in same.reasons
        assert KeyframeReason.CHANGED in moved.reasons
        assert not same.num_lost
        assert not moved.num_lost
        errors.append((same.ate_m, moved.ate_m))
    of_same, of_moved = np.median(errors, axis=0)
    assert of_moved <= 1.1 * of_same
