"""Results of frames: with all arrays, rejected, or as one line of a log."""

from dataclasses import dataclass

import numpy as np

from jaxslam.errors import JaxSlamError
from jaxslam.slam.mask_pipeline import FrameMask, MaskSource
from jaxslam.tracking.state import KeyframeReason, TrackOutput, TrackReason, TrackStatus


@dataclass(frozen=True, eq=False)
class FrameResult:
    """Result of tracking one frame.

    Attributes:
        timestamp_ns: Time of the frame, nanoseconds.
        T_world_cam: `(7,)` float64 pose of the camera as `wxyz_xyz`; the last known pose where `status` is `LOST`.
        covariance: `(6, 6)` covariance of the pose relative to the keyframes around it, in the tangent space at the
            camera: translation (m), then rotation (rad); see `PoseUncertainty`. It tells neither the drift of the map
            nor the place of another submap. It is 1e-12 on the diagonal at the first frame of a submap, which is the
            origin by definition, and 100 where `status` is `LOST`.
        status: Quality of the pose.
        reason: Reason why the pose is worse than `OK`, or why a `RELOCALIZED` frame had been lost; empty for `OK`.
        twist: `(6,)` velocity of the camera in its own axes: m/s, then rad/s.
        num_inliers: Number of tracked points that agree with the pose.
        inlier_ratio: Inliers as a share of the points that could be tracked.
        num_keyframe_matches: Number of points matched with the images of keyframes that agree with the pose.
        num_matched: Number of map points that were matched by descriptor and agree with the pose; 0 unless the frame
            was matched with the map, as weak and lost frames are.
        residual_px: Robust standard deviation of the reprojection errors of the inliers, pixels.
        uv: `(2, n)` float32 pixels of the points in the frame, new points included.
        weights: `(n,)` float32 weight of each point, 0 to 1; 0 for a slot without a point.
        followed: `(n,)` bool, true for points tracked from the frame before, false for new points.
        keyframe: Reason why the frame became a keyframe; `NONE` if it did not.
        correction: `(7,)` change of the map's frame since the frame before, from the old world to the new one, as
            `wxyz_xyz`. It is the part of the change of pose that is not motion of the camera.
        dynamic_mask: `(h, w)` bool, true for pixels that were ignored because they move or may move.
        mask_source: Origin of `dynamic_mask`.
        mask_age: Number of frames since the frame in which the mask was detected; -1 if it was not detected.
        detector_error: Error of the detector, reported once; empty if there is none.
        track_ms: Time that tracking the frame took, milliseconds.
        occluded_share: Share of the points of the reference keyframe that were blocked and then seen again; `None` if
            `dynamics.occlusion` is off, the frame was lost, or the map had no keyframe yet.
        warnings: Warnings about the input that were noticed at this frame, one sentence each; each is reported once.
            `Slam.warnings` has all of them.
        submap: Number of the submap that the pose is in. Poses of different submaps are in unrelated frames until a
            place of both is recognized and the submaps are merged.
        in_map_frame: Whether the submap is the one that the map began with, so that the pose is in the map's frame.
    """

    timestamp_ns: int
    T_world_cam: np.ndarray
    covariance: np.ndarray
    status: TrackStatus
    reason: str
    twist: np.ndarray
    num_inliers: int
    inlier_ratio: float
    num_keyframe_matches: int
    num_matched: int
    residual_px: float
    uv: np.ndarray
    weights: np.ndarray
    followed: np.ndarray
    keyframe: KeyframeReason
    correction: np.ndarray
    dynamic_mask: np.ndarray
    mask_source: MaskSource
    mask_age: int
    detector_error: str
    track_ms: float
    occluded_share: float | None = None
    warnings: tuple[str, ...] = ()
    submap: int = 0
    in_map_frame: bool = True

    @property
    def dynamic_ratio(self) -> float:
        """Share of the image that the mask covers."""
        return float(self.dynamic_mask.mean())

    @property
    def is_keyframe(self) -> bool:
        """Whether the frame became a keyframe."""
        return self.keyframe != KeyframeReason.NONE


@dataclass(frozen=True)
class Rejected:
    """A frame of a recording that the tracker did not get; tracking goes on with the next one.

    Attributes:
        timestamp_ns: Time of the frame, nanoseconds.
        error: Error that tells why.
        status: `REJECTED` if the frame could not be read or does not fit the camera, `DROPPED` if it came while
            another one was tracked.
    """

    timestamp_ns: int
    error: JaxSlamError
    status: TrackStatus = TrackStatus.REJECTED

    @property
    def reason(self) -> str:
        """Reason of the rejection."""
        return str(self.error)


@dataclass(frozen=True)
class FrameRecord:
    """Result of a frame without its arrays: one line of the log of a run.

    The attributes are those of `FrameResult`; a rejected frame has a time, a status and a reason only.
    """

    timestamp_ns: int
    status: TrackStatus
    reason: str
    num_inliers: int = 0
    inlier_ratio: float = 0.0
    num_keyframe_matches: int = 0
    num_matched: int = 0
    residual_px: float = 0.0
    keyframe: KeyframeReason = KeyframeReason.NONE
    dynamic_ratio: float = 0.0
    mask_source: MaskSource = MaskSource.NONE
    mask_age: int = -1
    detector_error: str = ""
    track_ms: float | None = None
    occluded_share: float | None = None
    submap: int | None = None

    @property
    def is_keyframe(self) -> bool:
        """Whether the frame became a keyframe."""
        return self.keyframe != KeyframeReason.NONE

    @classmethod
    def of(cls, result: "FrameResult | Rejected") -> "FrameRecord":
        """Make the record of a result."""
        if isinstance(result, Rejected):
            return cls(result.timestamp_ns, result.status, result.reason)
        return cls(
            timestamp_ns=result.timestamp_ns,
            status=result.status,
            reason=result.reason,
            num_inliers=result.num_inliers,
            inlier_ratio=result.inlier_ratio,
            num_keyframe_matches=result.num_keyframe_matches,
            num_matched=result.num_matched,
            residual_px=result.residual_px,
            keyframe=result.keyframe,
            dynamic_ratio=result.dynamic_ratio,
            mask_source=result.mask_source,
            mask_age=result.mask_age,
            detector_error=result.detector_error,
            track_ms=result.track_ms,
            occluded_share=result.occluded_share,
            submap=result.submap,
        )


def frame_result(
    timestamp_ns: int,
    output: TrackOutput,
    correction: np.ndarray,
    num_matched: int,
    mask: FrameMask,
    occluded_share: float | None = None,
) -> FrameResult:
    """Make the result of a frame from the output of the tracker.

    Args:
        timestamp_ns: Time of the frame, nanoseconds.
        output: Output of the tracker.
        correction: `(7,)` change of the map's frame since the frame before.
        num_matched: Number of map points that agree with the pose.
        mask: Mask of the frame.
        occluded_share: Share of occluded points of the reference keyframe; `None` if it is not known.
    """
    return FrameResult(
        timestamp_ns=timestamp_ns,
        T_world_cam=np.asarray(output.T_world_cam.wxyz_xyz, np.float64),
        covariance=np.asarray(output.covariance),
        status=TrackStatus(int(output.status)),
        reason=TrackReason(int(output.reason)).text,
        twist=np.asarray(output.twist, np.float64),
        num_inliers=int(output.num_inliers),
        inlier_ratio=float(output.inlier_ratio),
        num_keyframe_matches=int(output.num_keyframe_matches),
        num_matched=num_matched,
        residual_px=float(output.residual_px),
        uv=np.asarray(output.uv),
        weights=np.asarray(output.weights),
        followed=np.asarray(output.tracked),
        keyframe=KeyframeReason(int(output.keyframe)),
        correction=correction,
        dynamic_mask=mask.mask.copy(),
        mask_source=mask.source,
        mask_age=mask.age,
        detector_error=mask.error,
        track_ms=0.0,
        occluded_share=occluded_share,
    )
