"""NGD-SLAM in the rendered room: masks that come late and are carried on do as well as those that come at once.

All sixteen scenes, in full size: `tests/benchmarks/test_bench_dynamic_scenes.py`.
"""

from statistics import median

import pytest
from dynamic_scenes import errors, scene

from jaxslam.datasets.synthetic import SyntheticConfig
from jaxslam.datasets.synthetic.camera_path_kind import CameraPathKind

FRAMES, WIDTH, HEIGHT = 60, 320, 240
OVERRIDES = ("track.cell_px=12",)  # for a small image
ROOMS = 3
"""How much people harm is a matter of where they happen to walk: `static` errs by 18, 157 and 245 mm in those of
`halfsphere`, and the tracker by 2 to 4 mm without people in so small an image. No single room shows it."""
LATE_RATIO, STATIC_RATIO = 1.3, 5.0
SCENES: list[tuple[CameraPathKind, int]] = [("xyz", 2), ("halfsphere", 1)]
"""Some of those where `static` fails."""


@pytest.mark.slow
@pytest.mark.parametrize(("path", "people"), SCENES)
def test_late_masks_are_as_good(path: CameraPathKind, people: int) -> None:
    found = [
        errors(
            scene(SyntheticConfig(frames=FRAMES, width=WIDTH, height=HEIGHT, path=path, people=people, seed=room)),
            OVERRIDES,
        )
        for room in range(ROOMS)
    ]
    print(*found, sep="\n")
    assert max(room.late_ratio for room in found) <= LATE_RATIO
    assert median(room.static_ratio for room in found) >= STATIC_RATIO
