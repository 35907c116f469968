"""The camera that a calibration begins with, and where it comes from; never the name of a folder."""

from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxslam.datasets import Dataset, open_dataset
from jaxslam.datasets.paired_images import ImagePairs
from jaxslam.datasets.registry import calibration_in, layout_of
from jaxslam.errors import CameraError, DatasetError
from jaxslam.sensors.camera import Camera

GUESSED_FOV_DEG = 60.0
"""Horizontal field of view of most RGB-D cameras, within 10 degrees."""
_ANY = Camera("guess", 640, 480, 550.0, 550.0, 319.5, 239.5)


class StartCamera(NamedTuple):
    """A recording with the camera to begin with.

    Attributes:
        dataset: The recording, opened with that camera.
        source: Where the camera comes from, as part of a sentence.
    """

    dataset: Dataset
    source: str


def open_with_start(
    path: str | Path,
    kind: str = "auto",
    camera: Camera | str | Path | None = None,
    *,
    focal_px: float | None = None,
    depth_scale_per_m: float | None = None,
) -> StartCamera:
    """Open a recording with the camera that a calibration begins with.

    That is the given camera, or the one that `camera.yaml` or the calibration files of the layout say, or a guess: a
    principal point in the middle, no distortion, and the given focal length or a field of view of 60 degrees. The name
    of the folder tells nothing.

    Args:
        path: Folder of the recording.
        kind: Kind of the recording; `auto` recognizes it.
        camera: A camera, the name of a known one, or a camera file.
        focal_px: Focal length to begin with, pixels, in place of that of the camera, or as a guess without one.
        depth_scale_per_m: Counts of the depth images per meter, for a guess; by default those of the layout.

    Raises:
        DatasetError: If the recording cannot be opened, or its images have no size of their own.
        CameraError: If the camera cannot be loaded, or the focal length does not suit the images.
    """
    if camera is not None:
        dataset, source = open_dataset(path, kind, camera), "the given camera"
    elif (stated := calibration_in(path, kind)) is not None:
        dataset, source = open_dataset(path, kind, stated), "the calibration in the folder"
    else:
        guess = _guess(path, kind, focal_px, depth_scale_per_m)
        source = "a guess, with the given focal length"
        if focal_px is None:
            source = f"a guess: a field of view of {GUESSED_FOV_DEG:g} degrees"
        return StartCamera(open_dataset(path, kind, guess), source)
    if focal_px is None:
        return StartCamera(dataset, source)
    aspect = dataset.camera.fy / dataset.camera.fx
    other = replace(dataset.camera, fx=focal_px, fy=aspect * focal_px)
    return StartCamera(open_dataset(path, kind, other), f"{source}, with the given focal length")


def _guess(path: str | Path, kind: str, focal_px: float | None, depth_scale_per_m: float | None) -> Camera:
    scale = layout_of(path, kind).depth_scale_per_m if depth_scale_per_m is None else depth_scale_per_m
    probe = open_dataset(path, kind, replace(_ANY, depth_scale_per_m=scale))
    if not isinstance(probe, ImagePairs):
        raise DatasetError(f"{probe.name}: expected images in files, whose size can be looked up; give --camera")
    width, height = probe.image_size()
    focal = 0.5 * width / np.tan(np.deg2rad(0.5 * GUESSED_FOV_DEG)) if focal_px is None else focal_px
    try:
        return replace(
            _ANY, width=width, height=height, fx=focal, fy=focal, cx=0.5 * (width - 1), cy=0.5 * (height - 1),
            depth_scale_per_m=scale,
        )  # fmt: skip
    except CameraError as problem:
        raise CameraError(f"focal_px: {problem}") from None
