"""Checks of stereo pairs: sound ones, and what was broken on purpose."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from jaxslam.datasets import open_dataset
from jaxslam.datasets.diagnostics import Level, diagnose
from jaxslam.datasets.synthetic import SyntheticConfig, SyntheticDataset
from jaxslam.sensors.frame import Frame
from jaxslam.sensors.stereo_checks import look_over

ROOM = SyntheticDataset(SyntheticConfig(frames=1, people=0, baseline_m=0.1))


@pytest.fixture(scope="module")
def frame() -> Frame:
    return ROOM[0]


def _odd(frame: Frame) -> dict[str, str]:
    return {finding.topic: finding.consequence for finding in look_over([frame], ROOM.camera) if finding.odd}


def test_sound(frame: Frame) -> None:
    assert _odd(frame) == {}
    text = {finding.topic: finding.text for finding in look_over([frame], ROOM.camera)}
    assert "at a baseline of 0.100 m" in text["disparity"]


def test_broken(frame: Frame) -> None:
    assert frame.right is not None
    swapped = dataclasses.replace(frame, image=frame.right, right=frame.image)
    assert "left and right are swapped" in _odd(swapped)["sides"]
    shifted = dataclasses.replace(frame, right=np.roll(frame.right, 5, axis=0))
    assert "not rectified" in _odd(shifted)["rows"]
    dim = dataclasses.replace(frame, right=frame.right // 2)
    assert "exposed on its own" in _odd(dim)["brightness"]
    black = dataclasses.replace(frame, right=np.zeros_like(frame.right))
    assert set(_odd(black)) == {"brightness", "rows"}


def test_real(data_dir: Path) -> None:
    folder = data_dir / "kitti" / "sequences" / "06"
    assert list(look_over([open_dataset(folder)[0]], open_dataset(folder).camera))
    diagnosis = diagnose(folder)
    assert {"brightness", "rows", "disparity"} <= {finding.topic for finding in diagnosis.findings}
    assert diagnosis.at(Level.ERROR) == []
    assert not {"brightness", "rows", "disparity"} & {finding.topic for finding in diagnosis.at(Level.WARNING)}
