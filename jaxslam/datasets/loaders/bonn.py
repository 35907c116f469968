"""The Bonn RGB-D Dynamic dataset: the layout of TUM, folders named `rgbd_bonn_*`, and one camera for all.

Source: Palazzolo et al., "ReFusion: 3D Reconstruction in Dynamic Environments for RGB-D Cameras Exploiting
Residuals", IROS 2019. Its `groundtruth.txt` has the poses of the markers on the camera, two centimeters from the lens;
published errors are those to these poses, and ours are too.
"""

from pathlib import Path

from jaxslam.datasets.loaders.tum import DEPTH_SCALE_PER_M, LAYOUT, TumDataset, has_layout
from jaxslam.datasets.protocol import Fit, Loader
from jaxslam.sensors.camera import Camera

_PREFIX = "rgbd_bonn_"


def _fit(folder: Path) -> Fit:
    return Fit.NAME if folder.name.startswith(_PREFIX) and has_layout(folder) else Fit.NO


def _camera(_: Path) -> Camera:
    return Camera.load("bonn")


LOADER = Loader(
    "bonn",
    _fit,
    _camera,
    TumDataset,
    files="rgb.txt and depth.txt",
    parts=LAYOUT,
    depth_scale_per_m=DEPTH_SCALE_PER_M,
)
