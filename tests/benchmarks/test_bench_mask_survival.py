"""How well a mask agrees with the people in the picture 30 and 60 frames after the detector has found them last.

`JAXSLAM_DATA=... JAXSLAM_MODELS=... pytest -m benchmark -n 0 tests/benchmarks/test_bench_mask_survival.py -s`

The mask starts from the reference itself, undilated: DeepLab's masks of the people in Bonn `crowd`, the same with all
pictures turned by 180 degrees, and the true masks of rendered rooms. A start counts where the reference covers 1 % of
the picture or more. The poses are those of the tracker without a network, and the true ones in rooms.
"""

import functools
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from mask_survival import AFTER, LEAD_IN, Clip, Survival, rendered_clip, survival, tracked_clip, turned
from real_networks import real_network

from jaxslam.datasets import open_dataset
from jaxslam.datasets.synthetic.camera_path_kind import CameraPathKind
from jaxslam.semantics.detector import load_detector

pytestmark = pytest.mark.benchmark

STEP, NUM_FRAMES = 10, 927
ROOMS: list[tuple[CameraPathKind, int]] = [("xyz", 1), ("rpy", 2), ("halfsphere", 3), ("static", 2), ("loop", 2)]
"""Path of the camera and number of people of each rendered room."""
ROOM_STEP, ROOM_FRAMES = 10, 180
VARIANTS = {"propagated": False, "with new surfaces": True}


@functools.cache
def crowd(data_dir: Path) -> Clip:
    detector = load_detector(real_network("deeplabv3_mobilenetv2_voc"))

    def people(image: np.ndarray) -> np.ndarray:
        found = detector(image).class_mask
        return np.zeros(image.shape[:2], bool) if found is None else found

    return tracked_clip(open_dataset(data_dir / "bonn" / "rgbd_bonn_crowd"), NUM_FRAMES, people)


@functools.cache
def rooms() -> tuple[Clip, ...]:
    return tuple(
        rendered_clip(seed, ROOM_FRAMES, people=people, path=path) for seed, (path, people) in enumerate(ROOMS)
    )


def medians(clips: Sequence[Clip], step: int, capsys: pytest.CaptureFixture[str], name: str) -> tuple[float, float]:
    """Print the medians of every variant; return the median IoU with new surfaces after 30 and 60 frames."""
    iou = np.full((1, len(AFTER)), np.nan)
    for variant, new_surfaces in VARIANTS.items():
        every = []
        for clip in clips:
            starts = range(LEAD_IN, len(clip.frames) - AFTER[-1], step)
            every.append(survival(clip, starts, new_surfaces=new_surfaces))
        found = Survival(*(np.concatenate(columns) for columns in zip(*every, strict=True)))
        with capsys.disabled():
            print(f"\n{name}, {variant}, {len(found.starts)} starts: {found.medians()}")
        iou = found.iou
    assert np.isfinite(iou).sum(axis=0).min() >= 50
    after_30, after_60 = np.nanmedian(iou, axis=0).tolist()
    return after_30, after_60


def test_crowd(data_dir, capsys):
    after_30, after_60 = medians([crowd(data_dir)], STEP, capsys, "Bonn crowd against DeepLab")
    assert after_30 >= 0.70
    assert after_60 >= 0.60


def test_crowd_turned(data_dir, capsys):
    after_30, _ = medians([turned(crowd(data_dir))], STEP, capsys, "Bonn crowd turned by 180 degrees")
    assert after_30 >= 0.50


def test_rooms(capsys):
    after_30, after_60 = medians(rooms(), ROOM_STEP, capsys, "rendered rooms, true masks")
    assert after_30 >= 0.75
    assert after_60 >= 0.65
