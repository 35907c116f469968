"""Frames that move too far for optical flow are tracked by their features."""

import dataclasses
from collections.abc import Iterator
from typing import Any
from unittest import mock

import numpy as np
import pytest
from small_scene import CONFIG, HEIGHT, WIDTH

from jaxslam.datasets.synthetic import SyntheticConfig, SyntheticDataset
from jaxslam.geometry.se3 import angle, between, retract
from jaxslam.slam.slam import Slam
from jaxslam.tracking.state import TrackOutput, TrackStatus

SOURCE = SyntheticDataset(SyntheticConfig(width=WIDTH, height=HEIGHT, frames=120, people=0, path="rpy"))


@pytest.fixture(scope="module")
def slam() -> Iterator[Slam]:
    with Slam(SOURCE.camera, CONFIG) as slam:
        yield slam


@pytest.mark.parametrize(("first", "second"), [(20, 32), (40, 56), (60, 78)])
def test_the_second_frame_of_a_camera_that_turns_fast(slam: Slam, first: int, second: int) -> None:
    """By 0.25 to 0.3 rad, a third of the picture, from rest: nothing predicts it, and optical flow finds nothing."""
    slam.reset()
    start, result = slam.track(SOURCE[first]), slam.track(SOURCE[second])
    assert result.status in (TrackStatus.OK, TrackStatus.WEAK)
    moved = between(*SOURCE.T_world_cam[[first, second]])
    assert angle(moved) > 0.25
    wrong = between(moved, between(start.T_world_cam, result.T_world_cam))
    assert np.linalg.norm(wrong[4:]) < 0.03
    assert angle(wrong) < 0.015
    needs_features = slam._back.localizer._of_lost is not None
    assert needs_features == (first < 60)  # the shift of the whole image does not tell the first two, which roll


@pytest.mark.parametrize(("off_rad", "starts"), [(0.0, 3), (0.2, 4)])
def test_features_that_confirm_a_failed_turn_do_not_follow_again(
    slam: Slam, monkeypatch: pytest.MonkeyPatch, off_rad: float, starts: int
) -> None:
    """Flow from the velocity, from the turn, and after the reset; once more only if features tell another motion."""
    slam.reset()
    first = slam.track(SOURCE[20])
    moved = between(*SOURCE.T_world_cam[[20, 32]])
    turn = retract(moved, np.array([0, 0, 0, 0, off_rad, 0]))
    tracker, outputs = slam._tracker, []
    follow, advance = mock.Mock(wraps=tracker.follow), tracker.advance

    def lost_but_after_the_reset(*arguments: Any) -> TrackOutput:
        outputs.append(advance(*arguments))
        return outputs[-1]._replace(status=TrackStatus.LOST) if len(outputs) < starts else outputs[-1]

    monkeypatch.setattr(slam._back.localizer, "turn_to", lambda *_: turn)
    monkeypatch.setattr(tracker, "follow", follow)
    monkeypatch.setattr(tracker, "advance", lost_but_after_the_reset)
    result = slam.track(SOURCE[32])
    assert result.status in (TrackStatus.OK, TrackStatus.WEAK)
    assert follow.call_count == len(outputs) == starts
    assert np.linalg.norm(between(moved, between(first.T_world_cam, result.T_world_cam))[4:]) < 0.03


def test_a_frame_of_another_place_is_lost(slam: Slam) -> None:
    slam.reset()
    first = slam.track(SOURCE[20])
    other = SyntheticDataset(SyntheticConfig(width=WIDTH, height=HEIGHT, frames=2, people=0, seed=5))[1]
    later = dataclasses.replace(other, timestamp_ns=first.timestamp_ns + 100_000_000)
    assert slam.track(later).status == TrackStatus.LOST
