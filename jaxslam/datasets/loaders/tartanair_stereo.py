"""TartanAir as stereo pairs, even where there is depth: `kind="tartanair_stereo"`."""

from pathlib import Path

from jaxslam.datasets.loaders.tartanair import TartanAirDataset, tartanair_camera
from jaxslam.datasets.protocol import Fit, Loader
from jaxslam.sensors.camera import Camera


def _fit(_: Path) -> Fit:
    return Fit.NO  # chosen by name only: `tartanair` uses depth where available


def _camera(_: Path) -> Camera:
    return tartanair_camera(stereo=True)


LOADER = Loader("tartanair_stereo", _fit, _camera, TartanAirDataset, files="pose_left.txt and image_left")
