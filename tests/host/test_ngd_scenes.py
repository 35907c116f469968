"""NGD-SLAM in the rendered room: masks that come late and are carried on do as well as those that come at once.

All sixteen scenes, in full size: `tests/benchmarks/test_bench_dynamic_scenes.py`.
"""

import pytest
from dynamic_scenes import errors, scene

from jaxslam.datasets.synthetic import SyntheticConfig
from jaxslam.datasets.synthetic.camera_path import CameraPathKind

FRAMES, WIDTH, HEIGHT = 60, 320, 240
OVERRIDES = ("track.cell_px=12",)  # for a small image
LATE_RATIO, STATIC_RATIO = 1.3, 5.0
SCENES: list[tuple[CameraPathKind, int]] = [("xyz", 2), ("rpy", 3), ("halfsphere", 1)]
"""Some of those where `static` fails."""


@pytest.mark.parametrize(("path", "people"), SCENES)
def test_late_masks_are_as_good(path: CameraPathKind, people: int) -> None:
    found = errors(
        scene(SyntheticConfig(frames=FRAMES, width=WIDTH, height=HEIGHT, path=path, people=people)), OVERRIDES
    )
    print(found)
    assert found.late_ratio <= LATE_RATIO
    assert found.static_ratio >= STATIC_RATIO
