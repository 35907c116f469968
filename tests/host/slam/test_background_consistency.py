"""What has no depth has its say: where only people are near enough to be measured, poses are not said to be sure."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from room_round import TRACK

from jaxslam.config.schema import Config
from jaxslam.datasets import open_dataset
from jaxslam.datasets.synthetic import SyntheticConfig, SyntheticDataset
from jaxslam.datasets.synthetic.camera_path_kind import CameraPathKind
from jaxslam.geometry.se3 import between
from jaxslam.sensors.frame import Frame
from jaxslam.slam.frame_result import FrameResult
from jaxslam.slam.slam import Slam
from jaxslam.tracking.state import TrackReason, TrackStatus

CONFIG = Config(track=TRACK)


def near_only(frame: Frame, farthest_m: float) -> Frame:
    """The frame as a sensor with less reach takes it."""
    assert frame.depth_m is not None
    return replace(frame, depth_m=np.where(frame.depth_m > farthest_m, np.float32(0), frame.depth_m))


def tracked(path: CameraPathKind, people: int, seed: int, reach_m: float) -> tuple[list[FrameResult], np.ndarray]:
    """Results with depth as far as `reach_m`, and how far each is from the truth, the first frame as their world."""
    frames = 40
    room = SyntheticDataset(
        SyntheticConfig(width=320, height=240, frames=frames, people=people, path=path, seed=seed, fps=30.0)
    )
    with Slam(room.camera, CONFIG) as slam:
        results = [slam.track(near_only(room[index], reach_m)) for index in range(frames)]
    first = next(index for index, result in enumerate(results) if result.status == TrackStatus.STARTED)
    true = room.ground_truth.T_world_cam
    given = np.array([result.T_world_cam for result in results])
    apart = between(given[first][None], given)[:, 4:] - between(true[first][None], true)[:, 4:]
    return results[first:], np.linalg.norm(apart, axis=1)[first:]


def sigma_m(result: FrameResult) -> float:
    return float(np.sqrt(np.trace(result.covariance[:3, :3])))


class TestOnlyPeople:
    @pytest.mark.slow
    @pytest.mark.parametrize(("path", "seed"), [("xyz", 0), ("static", 1)])
    def test_no_wrong_pose_is_sure(self, path: CameraPathKind, seed: int) -> None:
        """All are carried along with the people; those said to be OK are within 5 standard deviations."""
        results, errors_m = tracked(path, 2, seed, 2.0)
        assert errors_m.max() > 0.3
        fine = [place for place, result in enumerate(results) if result.status == TrackStatus.OK]
        wrong = [place for place in fine if errors_m[place] > 5 * sigma_m(results[place])]
        print(f"{path}: errors up to {errors_m.max():.2f} m, {len(fine)} of {len(results)} OK, {len(wrong)} wrong")
        assert not wrong
        weak = [result for result in results if result.reason == TrackReason.UNCONFIRMED.text]
        assert len(weak) > len(results) / 4
        assert {result.status for result in weak} == {TrackStatus.WEAK}

    @pytest.mark.slow
    @pytest.mark.parametrize(("path", "reach_m"), [("rpy", 2.6), ("xyz", 2.6)])
    def test_nobody(self, path: CameraPathKind, reach_m: float) -> None:
        """Little depth, but of things at rest: the background confirms the pose, no frame is weak for it."""
        results, errors_m = tracked(path, 0, 1, reach_m)
        unsure_m = max(map(sigma_m, results))
        print(f"{path}: {len(results)} frames, errors up to {errors_m.max():.3f} m, up to {unsure_m:.3f} m unsure")
        assert TrackReason.UNCONFIRMED.text not in {result.reason for result in results}
        assert errors_m.max() < 0.1


class TestOrdinary:
    def test_recording_with_depth_nearly_everywhere(self, data_dir: Path) -> None:
        """Nothing is looked at, and the covariance is that of the points."""
        dataset = open_dataset(data_dir / "bonn/rgbd_bonn_crowd")
        with Slam(dataset.camera) as slam:
            results = [slam.track(dataset[index]) for index in range(12)]
            assert slam._background is not None
            assert slam._background._previous is None
        assert {result.status for result in results[1:]} == {TrackStatus.OK}
        assert max(map(sigma_m, results[1:])) < 0.02


class TestSomethingNear:
    """Something too near for the sensor has no depth either, and moves as it likes."""

    @pytest.mark.slow
    def test_doubt_ends_where_the_background_is_seen_again(self) -> None:
        """Something passes before the left half of the picture; the right half agrees with the map all the time."""
        frames, passes = 60, range(10, 35)
        room = SyntheticDataset(SyntheticConfig(width=320, height=240, frames=frames, path="xyz", seed=3, fps=30.0))
        rng = np.random.default_rng(0)
        texture = np.repeat(np.repeat(rng.integers(0, 255, (30, 80, 3), dtype=np.uint8), 8, axis=0), 8, axis=1)
        statuses = []
        with Slam(room.camera, CONFIG) as slam:
            for index in range(frames):
                frame = room[index]
                if index in passes:
                    image, depth_m = frame.image.copy(), np.array(frame.depth_m)
                    moved = 12 * (index - passes.start)
                    image[:, :160], depth_m[:, :160] = texture[:, moved : moved + 160], 0
                    frame = replace(frame, image=image, depth_m=depth_m)
                result = slam.track(frame)
                statuses.append((result.status, result.reason))
        unconfirmed = [index for index, status in enumerate(statuses) if status[1] == TrackReason.UNCONFIRMED.text]
        assert unconfirmed
        assert max(unconfirmed) < passes.stop + 20
        assert {status for status, _ in statuses[passes.stop + 20 :]} == {TrackStatus.OK}
