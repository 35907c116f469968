"""Correction of the constant errors of a depth sensor, which calibration finds: an offset, and a delay."""

from dataclasses import replace

import numpy as np

from jaxslam.sensors.camera import Camera
from jaxslam.sensors.frame import Frame


def with_corrected_depth(frame: Frame, camera: Camera) -> Frame:
    """Return a frame without the constant errors of the depth sensor; as it is where there are none, or no depth.

    Args:
        frame: The frame as it came.
        camera: The camera, with `depth_offset_m` and `depth_delay_s`.
    """
    if frame.depth_m is None or camera.is_stereo or not (camera.depth_offset_m or camera.depth_delay_s):
        return frame
    depth_m = frame.depth_m
    if camera.depth_offset_m:
        with np.errstate(invalid="ignore"):  # depth may be NaN where missing
            depth_m = np.where(depth_m > 0, np.maximum(depth_m - np.float32(camera.depth_offset_m), 0), 0)
    sign = -1 if frame.played_backward else 1
    delay_ns = frame.depth_delay_ns + sign * round(1e9 * camera.depth_delay_s)
    return replace(frame, depth_m=depth_m, depth_timestamp_ns=frame.timestamp_ns + delay_ns)
