"""Carrying a person's mask to the next frame, and comparing depth images, beside OpenCV's LK on the same frames.

`pytest -m benchmark -n 0 tests/benchmarks/test_bench_masks.py -s`
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxlie import SE3
from jaxslam_kernels.camera import make_intrinsics
from jaxslam_kernels.depth.depth_change import depth_change
from jaxslam_kernels.image.pyramid import Pyramid, build_pyramid

from jaxslam.benchmark.reference_flow import corners_of, opencv_flow
from jaxslam.benchmark.timing import Comparison, compare, compile_seconds
from jaxslam.datasets.synthetic import SyntheticConfig, SyntheticDataset
from jaxslam.geometry.se3 import between
from jaxslam.masks.propagation import PYRAMID_LEVELS, TrackedMask, follow, make_origin, predicted_mask
from jaxslam.sensors.downscale import Downscaler, ImageGrid
from jaxslam.sensors.frame import to_gray
from jaxslam.slam.mask_pipeline import WIDTH_PX

pytestmark = pytest.mark.benchmark

FRAME = 21
"""In which the person fills a fifth of the image; the next is the one the mask is carried to."""
EARLIER = (5, 10, 15)
"""So many frames before are the depth images compared with."""
STEP = 4
"""Of whose pixels and rows every so many are used: 160 x 120."""

_pyramid = jax.jit(partial(build_pyramid, num_levels=PYRAMID_LEVELS))


class View(NamedTuple):
    gray: np.ndarray
    depth: np.ndarray
    person: np.ndarray


@pytest.fixture(scope="module")
def dataset() -> SyntheticDataset:
    return SyntheticDataset(SyntheticConfig(seed=1, people=1, frames=FRAME + 2))


@pytest.fixture(scope="module")
def views(dataset) -> tuple[View, View]:
    before, now = (dataset.render(index) for index in (FRAME, FRAME + 1))
    view = lambda frame: View(to_gray(frame.rgb), frame.depth_m, frame.instance_mask > 0)
    return view(before), view(now)


@pytest.fixture(scope="module")
def opencv(views):
    """What everything is compared with: flow of 1000 points, both pyramids included."""
    before, now = (view.gray for view in views)
    corners = corners_of(before)
    assert len(corners) == 1000
    return lambda: opencv_flow(before, now, corners)


def _carry(reduced: Downscaler, before: Pyramid, origin: TrackedMask, now: View) -> np.ndarray:
    """The new mask, from the old one and its points, and both frames, of which the earlier one's pyramid is there."""
    depth = np.ascontiguousarray(reduced.every(now.depth))
    _, followed = follow(origin, [before], reduced.mean(now.gray), depth)
    return reduced.whole(predicted_mask(origin, followed, depth, 6.0))


def test_carrying_a_mask(dataset, views, opencv, capsys):
    """Half the time of OpenCV's flow at most, all that the tracker may wait for included."""
    before, now = views
    reduced = Downscaler(ImageGrid.of(dataset.camera), WIDTH_PX)
    small, mask_before = reduced.mean(before.gray), np.ascontiguousarray(reduced.every(before.person))
    pyramid, origin = _pyramid(small), make_origin(mask_before, small, 0)
    gray, depth = reduced.mean(now.gray), np.ascontiguousarray(reduced.every(now.depth))
    _, followed = follow(origin, [pyramid], gray, depth)
    mask = _carry(reduced, pyramid, origin, now)
    overlap = np.count_nonzero(mask & now.person) / np.count_nonzero(mask | now.person)
    assert 0.15 < before.person.mean() < 0.25
    assert overlap > 0.8
    pieces = {
        "points of the mask": lambda: make_origin(mask_before, small, 0),
        "smaller image": lambda: reduced.mean(now.gray),
        "flow, objects": lambda: follow(origin, [pyramid], gray, depth),
        "new mask": lambda: predicted_mask(origin, followed, depth, 6.0),
        "larger mask": lambda: reduced.whole(mask_before),
    }
    compared: dict[str, Comparison] = {name: compare(piece, opencv) for name, piece in pieces.items()}
    whole = compare(lambda: _carry(reduced, pyramid, make_origin(mask_before, small, 0), now), opencv)
    with capsys.disabled():
        print(f"\n{before.person.mean():.0%} of the image, {origin.ok.sum()} points, overlap {overlap:.2f}")
        for name, comparison in compared.items():
            print(f"  {name}: {comparison}")
        print(f"  whole: {whole}")
    assert whole.processor_ratio <= 0.5


def test_comparing_depth(dataset, opencv, capsys):
    """One image of 160 x 120 with three earlier ones."""
    camera = dataset.camera
    intrinsics = make_intrinsics(*(value / STEP for value in (camera.fx, camera.fy, camera.cx, camera.cy)))
    now, *then = (
        jnp.asarray(dataset.render(index).depth_m[::STEP, ::STEP]) for index in (FRAME, *(FRAME - k for k in EARLIER))
    )
    poses = [between(dataset.T_world_cam[FRAME - k], dataset.T_world_cam[FRAME]) for k in EARLIER]
    arguments = (now, jnp.stack(then), SE3(jnp.asarray(np.stack(poses), jnp.float32)), intrinsics)
    run = jax.vmap(depth_change, in_axes=(None, 0, 0, None))
    ours = jax.jit(run)
    change = ours(*arguments)
    person = dataset.render(FRAME).instance_mask[::STEP, ::STEP] > 0
    same, new = np.asarray(change.same), np.asarray(change.new)
    assert now.shape == (120, 160)
    assert same[:, ~person].mean() > 0.5  # the person hid much of the rest
    assert new[-1][person].mean() > 0.5
    assert new[:, ~person].mean() < 0.02
    comparison = compare(lambda: ours(*arguments), opencv)
    with capsys.disabled():
        seconds = compile_seconds(run, *arguments)
        print(f"\ndepth_change with {len(EARLIER)} images, compiled in {seconds:.2f} s: {comparison}")
        print(f"  new of the person {new[-1][person].mean():.2f}, of the rest {new[-1][~person].mean():.3f}")
    assert comparison.processor_ratio <= 0.2
