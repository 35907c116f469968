"""A result of a frame, made by hand."""

import numpy as np

from jaxslam.geometry.se3 import IDENTITY
from jaxslam.slam.frame_result import FrameResult
from jaxslam.slam.mask_pipeline import MaskSource
from jaxslam.tracking.state import KeyframeReason, TrackStatus

_NOTHING = np.zeros(0)
RESULT = FrameResult(
    timestamp_ns=0,
    T_world_cam=IDENTITY,
    covariance=np.eye(6, dtype=np.float32),
    status=TrackStatus.OK,
    reason="",
    twist=np.zeros(6),
    num_inliers=0,
    inlier_ratio=0.0,
    num_keyframe_matches=0,
    num_matched=0,
    residual_px=0.0,
    uv=_NOTHING,
    weights=_NOTHING,
    followed=_NOTHING,
    keyframe=KeyframeReason.NONE,
    correction=IDENTITY,
    dynamic_mask=np.zeros((2, 2), bool),
    mask_source=MaskSource.NONE,
    mask_age=-1,
    detector_error="",
    track_ms=0.0,
)
"""An `OK` frame at the origin."""
