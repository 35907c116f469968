"""Result of a frame: with all arrays, rejected, or as one line of a log."""

from dataclasses import dataclass

import numpy as np

from jaxslam.errors import JaxSlamError
from jaxslam.slam.mask_pipeline import FrameMask, MaskSource
from jaxslam.tracking.state import KeyframeReason, TrackOutput, TrackReason, TrackStatus


@dataclass(frozen=True, eq=False)
class FrameResult:
    """Result of tracking one frame.

    Attributes:
        timestamp_ns: Its time.
        T_world_cam: `(7,)` float64 pose of the camera as `wxyz_xyz`; the last one where `status` is `LOST`.
        covariance: `(6, 6)` of the pose in its submap, in the tangent space at the camera: translation (m), then
            rotation (rad). It says how well the image fixes the pose among the points around; not how far the map has
            drifted since it began, nor where the world of another submap is. At the first frame of a submap, which is
            its origin by definition, 1e-12 on the diagonal; 100 where `status` is `LOST`.
        status: Quality of the pose.
        reason: Why it is not worth more, and of `RELOCALIZED` why flow had lost it; empty if it is `OK`.
        twist: `(6,)` velocity of the camera in its own axes: m/s, then rad/s.
        num_inliers: Followed points that agree with the pose.
        inlier_ratio: Their share of the points that could be followed.
        num_keyframe_matches: Points found again in keyframes, by their picture.
        num_matched: Points of the map that were found by their descriptor and agree with the pose, sought where flow
            is weak or lost.
        residual_px: Robust standard deviation of the inliers' reprojection error, pixels.
        uv: `(2, n)` float32 pixels of the points in the frame, those just found included.
        weights: `(n,)` float32 weight of each, 0 to 1; 0 for a slot without a point.
        followed: `(n,)` bool, true for points that came from the frame before, false for new ones.
        keyframe: Why the frame was kept, `NONE` if it was not.
        correction: `(7,)` how the map's frame changed since the frame before, from the old world to the new one, as
            `wxyz_xyz`: the part of the change of pose that is no motion of the camera.
        dynamic_mask: `(h, w)` bool, true where nothing was trusted because it moves or may.
        mask_source: Origin of `dynamic_mask`.
        mask_age: Frames since the one it was detected in; -1 if it was not.
        detector_error: Error of the detector, reported once; empty if there is none.
        track_ms: Time it took, in milliseconds.
        occluded_share: Share of the points of the keyframe it hangs on that something passed before and that were seen
            again; `None` if the settings do not ask for it, it was lost, or the map had no keyframe yet.
        warnings: Warnings about the input that were noticed at this frame, a sentence each; each is reported
            once. `Slam.warnings` has all of them.
        submap: Number of the submap that the pose is in. Poses of different submaps are in different worlds, which
            have nothing to do with each other until a place of both is recognized and they become one.
        in_map_frame: Whether that is the submap that the map began with, so that the pose is in the frame of the map.
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
        """Whether the frame was kept."""
        return self.keyframe != KeyframeReason.NONE


@dataclass(frozen=True)
class Rejected:
    """A frame of a recording that never reached the tracker; tracking goes on with the next one.

    Attributes:
        timestamp_ns: Its time.
        error: Why.
        status: `REJECTED` if it could not be read or does not fit, `DROPPED` if it came late.
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
    """One line of a run's log: the result of a frame without its arrays.

    Attributes are those of `FrameResult`; a rejected frame has only a time, a status and a reason.
    """

    timestamp_ns: int
    status: TrackStatus
    reason: str
    num_inliers: int = 0
    inlier_ratio: float = 0.0
    num_keyframe_matches: int = 0
    num_matched: int = 0
    residual_px: float = 0.0
    is_keyframe: bool = False
    dynamic_ratio: float = 0.0
    mask_source: MaskSource = MaskSource.NONE
    mask_age: int = -1
    detector_error: str = ""
    track_ms: float | None = None
    occluded_share: float | None = None
    submap: int | None = None

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
            is_keyframe=result.is_keyframe,
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
    """The result of a frame, from what the compiled step said of it."""
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
