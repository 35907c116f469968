"""Difference between two calibrations, in pixels of the image."""

import cv2
import numpy as np

from jaxslam.sensors.camera import Camera

_MIN_PX, _MIN_SHARE = 1.0, 0.003
"""Mean distance below which two calibrations may be of one camera, in pixels and as a share of the image width."""
_MIN_BASELINE = 0.02
"""Difference of two baselines below which they may be of one stereo pair, as a share of the longer one."""
_STEPS = 9


def difference_of_cameras(first: Camera, second: Camera) -> str:
    """Describe what differs between two cameras by more than calibrating one camera twice would; empty if nothing does.

    Args:
        first: One camera.
        second: The camera to compare with it.
    """
    sizes = [f"{camera.width}x{camera.height}" for camera in (first, second)]
    if sizes[0] != sizes[1]:
        return f"{sizes[0]} and {sizes[1]} pixels"
    if first.is_stereo and second.is_stereo:
        baselines = first.baseline_m or 0.0, second.baseline_m or 0.0
        if abs(baselines[0] - baselines[1]) > _MIN_BASELINE * max(baselines):
            return f"a baseline of {baselines[0]:g} m and one of {baselines[1]:g} m"
    apart_px = distance_of_projections_px(first, second)
    if apart_px <= max(_MIN_PX, _MIN_SHARE * first.width):
        return ""
    return (
        f"fx {first.fx:.1f} and {second.fx:.1f}, k1 {first.distortion[0]:g} and {second.distortion[0]:g},"
        f" a mean of {apart_px:.1f} pixels apart"
    )


def distance_of_projections_px(first: Camera, second: Camera) -> float:
    """Return the mean distance, in pixels, between the projections of the same directions into two cameras.

    Args:
        first: The camera whose pixels, on a grid over the image, define the directions.
        second: The camera into which the directions are projected, of the same image size.
    """
    u, v = np.meshgrid(np.linspace(0, first.width - 1, _STEPS), np.linspace(0, first.height - 1, _STEPS))
    pixels = np.stack([u.ravel(), v.ravel()], axis=1)
    rays = cv2.undistortPoints(pixels[:, None], _matrix(first), np.array(first.distortion))
    points = cv2.convertPointsToHomogeneous(rays)
    seen, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), _matrix(second), np.array(second.distortion))
    return float(np.linalg.norm(seen[:, 0] - pixels, axis=1).mean())


def _matrix(camera: Camera) -> np.ndarray:
    return np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
