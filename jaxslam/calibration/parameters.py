"""The parameters of a camera that a recording can tell: names, units, groups, and what is assumed before looking."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxslam.sensors.camera import Camera

CameraVector = Float[np.ndarray, "17"]
"""Values of `PARAMETERS`, in their order and units."""


class Parameter(NamedTuple):
    """One parameter.

    Attributes:
        name: Name in reports; that of the field of `Camera` where there is one.
        unit: Unit.
        group: Group that is accepted or rejected as a whole.
        sigma: Standard deviation that is assumed before the recording is looked at, in `unit`. That of focal lengths
            and of the principal point is a share: of the focal length, and of the width of the image.
    """

    name: str
    unit: str
    group: str
    sigma: float


FOCAL, CENTER, DISTORTION, DEPTH_OFFSET, DEPTH_DELAY, READOUT, EXTRINSICS = GROUPS = (
    "focal length",
    "center",
    "distortion",
    "depth offset",
    "depth delay",
    "readout",
    "depth extrinsics",
)
"""Groups of parameters, in the order of reports."""

PARAMETERS = (
    Parameter("fx", "px", FOCAL, 0.1),
    Parameter("fy", "px", FOCAL, 0.1),
    Parameter("cx", "px", CENTER, 0.05),
    Parameter("cy", "px", CENTER, 0.05),
    Parameter("k1", "", DISTORTION, 0.5),
    Parameter("k2", "", DISTORTION, 1.0),
    Parameter("p1", "", DISTORTION, 0.01),
    Parameter("p2", "", DISTORTION, 0.01),
    Parameter("k3", "", DISTORTION, 1.0),
    Parameter("depth_offset_m", "m", DEPTH_OFFSET, 0.1),
    Parameter("depth_delay_s", "s", DEPTH_DELAY, 0.03),
    Parameter("readout_s", "s", READOUT, 0.03),
    Parameter("depth_turn_x", "rad", EXTRINSICS, 0.01),
    Parameter("depth_turn_y", "rad", EXTRINSICS, 0.01),
    Parameter("depth_turn_z", "rad", EXTRINSICS, 0.01),
    Parameter("depth_shift_x", "m", EXTRINSICS, 0.01),
    Parameter("depth_shift_y", "m", EXTRINSICS, 0.01),
)
"""All parameters, in the order in which vectors hold them.

The extrinsics lead from the color camera to the depth camera: `X_depth = R (X_color + shift)`. A shift along the
optical axis is the same as a depth offset, and left to that."""


def index_of(name: str) -> int:
    """Return the place of a parameter in `PARAMETERS` and in vectors."""
    return [parameter.name for parameter in PARAMETERS].index(name)


def group_mask(groups: tuple[str, ...]) -> np.ndarray:
    """Return which of `PARAMETERS` belong to some groups, `(q,)` bool."""
    return np.array([parameter.group in groups for parameter in PARAMETERS])


def vector_of(camera: Camera) -> CameraVector:
    """Return the parameters of a camera; its depth camera is taken to be where the color camera is."""
    lens = (camera.fx, camera.fy, camera.cx, camera.cy, *camera.distortion)
    return np.array([*lens, camera.depth_offset_m, camera.depth_delay_s, camera.readout_s, *5 * [0.0]])


def prior_sigmas(camera: Camera) -> CameraVector:
    """Return the standard deviations that are assumed before looking, in the units of the parameters."""
    scales = {FOCAL: camera.fx, CENTER: float(camera.width)}
    return np.array([parameter.sigma * scales.get(parameter.group, 1.0) for parameter in PARAMETERS])


def camera_of(vector: CameraVector, start: Camera) -> Camera:
    """Return a camera with other parameters; the extrinsics of its depth camera are left out.

    Raises:
        CameraError: If the parameters are impossible.
    """
    values = {parameter.name: value for parameter, value in zip(PARAMETERS, vector.tolist(), strict=True)}
    fields = ("fx", "fy", "cx", "cy", "depth_offset_m", "depth_delay_s", "readout_s")
    lens = tuple(values[name] for name in ("k1", "k2", "p1", "p2", "k3"))
    return replace(start, **{name: values[name] for name in fields}, distortion=lens)
