"""Optical flow of 1000 points beside `cv2.calcOpticalFlowPyrLK`: time, and error on known warps."""

import cv2
import jax
import numpy as np
import pytest
from jax.extend.backend import clear_backends
from jaxslam_kernels.flow.lk_flow import lk_flow
from jaxslam_kernels.image.pyramid import build_pyramid

from jaxslam.benchmark.kernels.scenes.image_warps import corners, picture, warp
from jaxslam.benchmark.timing import compare

pytestmark = pytest.mark.benchmark

COUNT_AND_EPS = cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS
CRITERIA = {"10 iterations, 0.03 px": (COUNT_AND_EPS, 10, 0.03), "30 iterations, 0.01 px": (COUNT_AND_EPS, 30, 0.01)}
"""The fastest in common use, which we compare with, and OpenCV's default."""
SHIFTS_PX = (5, 8, 10, 10, 10, 12, 15, 15, 18, 20, 20, 25)


@pytest.fixture(scope="module", autouse=True)
def one_thread():
    """One thread for XLA, as for OpenCV.

    A pool of two that is pinned to one core afterwards costs 40 %: XLA then splits every cutting of patches in two and
    waits for both halves.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("NPROC", "1")  # XLA reads it when JAX makes its first array
        clear_backends()
        yield
    clear_backends()


@jax.jit
def _pyramid(image):
    return build_pyramid(image)


@jax.jit
def _flow(previous, current, points):
    return lk_flow(previous, current, points).points


@jax.jit
def _pyramids_and_flow(previous, current, points):
    return _flow(_pyramid(previous), _pyramid(current), points)


def _opencv(previous, current, points, criteria):
    return cv2.calcOpticalFlowPyrLK(
        previous, current, points, points.copy(), winSize=(21, 21), maxLevel=3, criteria=criteria
    )[0]


@pytest.fixture(params=["warp of 10 px", "TUM fr1/rpy"])
def pair(request):
    """Two pictures."""
    if request.param == "warp of 10 px":
        return warp(picture(640, 480), 10.0, 2)[:2]
    folder = request.getfixturevalue("data_dir") / "tum" / "rgbd_dataset_freiburg1_rpy_excerpt" / "rgb"
    paths = sorted(folder.iterdir())
    return tuple(cv2.imread(str(paths[index]), cv2.IMREAD_GRAYSCALE) for index in (60, 61))


def test_is_not_slower_than_opencv(pair, request, capsys):
    previous, current = pair
    points = corners(previous, 1000)
    rows = np.ascontiguousarray(points.T)
    pyramids = _pyramid(previous), _pyramid(current)
    whole = lambda: _pyramids_and_flow(previous, current, points)
    ratios = {}
    with capsys.disabled():
        print(f"\n{request.node.callspec.id}")
        for name, criteria in CRITERIA.items():
            theirs = lambda criteria=criteria: _opencv(previous, current, rows, criteria)
            ratios[name] = compare(whole, theirs).ratio
            print(f"  both pyramids and flow against OpenCV, {name}: {compare(whole, theirs)}")
            print(f"  flow alone against the same: {compare(lambda: _flow(*pyramids, points), theirs)}")
    assert max(ratios.values()) <= 1.0


def test_is_not_less_accurate_than_opencv(capsys):
    image = picture(640, 480)
    points = corners(image, 1000)
    errors = {name: [] for name in ("ours", *CRITERIA)}
    for seed, shift_px in enumerate(SHIFTS_PX):
        known = warp(image, shift_px, seed)
        visible, truth = known.visible(points), known.move(points)
        found = {"ours": _pyramids_and_flow(image, known.current, points)}
        for name, criteria in CRITERIA.items():
            found[name] = _opencv(image, known.current, np.ascontiguousarray(points.T), criteria).T
        for name, positions in found.items():
            errors[name].append(np.linalg.norm(np.asarray(positions) - truth, axis=0)[visible])
    figures = {name: (np.mean(e < 1), np.median(e)) for name, e in ((n, np.concatenate(e)) for n, e in errors.items())}
    with capsys.disabled():
        print(f"\n{len(SHIFTS_PX)} warps of {min(SHIFTS_PX)} to {max(SHIFTS_PX)} px, {len(points.T)} points each")
        for name, (share, median) in figures.items():
            print(f"  {name}: share within a pixel {share:.4f}, median error {median:.4f} px")
    share, median = figures.pop("ours")
    assert all(share >= other for other, _ in figures.values())
    assert all(median <= other * 1.02 for _, other in figures.values())  # 2 % is noise
