"""What frames of the rendered room truly show, and how near a dense map is to it."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.spatial import KDTree

from jaxslam.datasets.synthetic import SyntheticDataset
from jaxslam.datasets.synthetic.dataset import SyntheticFrame
from jaxslam.dense.depth_view import DepthView
from jaxslam.geometry.se3 import transform

SEEN_M, COVERED_M = 6.0, 0.03
EVERY = 6


class Accuracy(NamedTuple):
    """Mean distance of points from the true surface, meters, and how much of it has a point nearby."""

    mean_m: float
    coverage: float


def true_surface(source: SyntheticDataset, frames: Sequence[SyntheticFrame], *, people: bool) -> np.ndarray:
    """`(n, 3)` the true surface that frames see up to six meters, of what stands still or of who moves."""
    view, points = DepthView(source.camera, 1, 100.0, 0.1), []
    for frame in frames:
        z = frame.exact_depth_m.reshape(1, -1)
        chosen = ((frame.instance_mask > 0) == people).ravel() & (z[0] < SEEN_M) & (frame.depth_m > 0).ravel()
        points.append(transform(frame.T_world_cam, np.concatenate([view.rays * z, z])[:, chosen].astype(float)).T)
    return np.concatenate(points)


def accuracy(points: np.ndarray, source: SyntheticDataset) -> Accuracy:
    """Of the points `(n, 3)` of a run through the whole room, whose world is the first frame's camera."""
    frames = [source.render(index) for index in range(0, len(source), EVERY)]
    surface = true_surface(source, frames, people=False)
    points = transform(frames[0].T_world_cam, points.T.astype(float)).T
    return Accuracy(
        float(np.mean(KDTree(surface[::2]).query(points)[0])),
        float(np.mean(KDTree(points).query(surface[::37])[0] < COVERED_M)),
    )
