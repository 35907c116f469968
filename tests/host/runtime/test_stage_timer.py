"""Durations of stages: of all frames, and of keyframes alone."""

import numpy as np
import pytest

from jaxslam.runtime import stage_timer
from jaxslam.runtime.stage_timer import StageTimes


def test_keyframes_apart() -> None:
    """What ran several times in a frame counts as one duration of it; a stage that did not run counts nothing."""
    times = StageTimes()
    times.add("flow", 0.002)
    times.frame_ends(is_keyframe=False)
    for seconds in (0.003, 0.004):
        times.add("flow", seconds)
    times.add("detector", 0.050)
    times.frame_ends(is_keyframe=True)
    times.frame_ends(is_keyframe=True)
    np.testing.assert_allclose(times.ms["flow"], [2, 3, 4])
    assert times.keyframe_ms.keys() == {"flow", "detector"}
    np.testing.assert_allclose(times.keyframe_ms["flow"], [7])
    np.testing.assert_allclose(times.keyframe_ms["detector"], [50])


def test_memory_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stage_timer, "NUM_KEPT", 5)
    times = StageTimes()
    for number in range(24):
        times.add("flow", 1e-3 * number)
        times.frame_ends(is_keyframe=True)
    for kept in (times.ms["flow"], times.keyframe_ms["flow"]):
        assert 5 <= len(kept) < 10
        assert kept[-1] == pytest.approx(23)
