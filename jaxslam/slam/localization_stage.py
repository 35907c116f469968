"""The stage after pose estimation: localize in the map the frames whose pose alone is not enough."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxslam.config.schema import Config
from jaxslam.geometry.se3 import IDENTITY, between, displacement
from jaxslam.geometry.types import Pose
from jaxslam.mapping.local_map_tracking import RADII_PX, WIDE_RADII_PX
from jaxslam.sensors.frame_arrays import FrameArrays
from jaxslam.slam.back_end import BackEnd
from jaxslam.slam.frame_localizer import FeatureMotion, LocalizedPose
from jaxslam.slam.outside_motion import MeasuredMotion
from jaxslam.slam.pose_history import ConstantVelocity
from jaxslam.slam.program_compiler import ProgramCompiler
from jaxslam.slam.tracker import MapWishes, Tracker
from jaxslam.slam.tracker_map_sync import AnchoredPose, pose_of
from jaxslam.tracking.state import TrackOutput, TrackReason, TrackState, TrackStatus
from jaxslam.tracking.step import FlowResult

_MIN_VIEWS = 2
"""Number of keyframes that show the view from which the map is expected to show points of the frame."""
_MIN_SHARE = 0.1
"""Share of the tracked points, or of the points of keyframes that were looked for if these are fewer, below which those
that agree are few. Where the camera of fr1_rpy turns fast, a frame comes out 3 to 8 cm off now and then; optical flow
goes on from there, and agrees with itself. Of 3,200 frames to and fro, 2 % of them dropped, 314 and 92 were 2 cm off
(seeds 1 and 2); with this, 14 and 12 are. It matched 7 and 2 frames with the map, and none of Bonn `crowd`, KITTI 06,
the kitchen, and fr1_rpy as recorded."""
_SAME_START_PX = 10.0
"""Median distance of starts from which optical flow finds the same: it reaches three times as far. Another flow and
pose take 25 to 35 ms (fr1_rpy live, AMD EPYC)."""
_PAUSE = 5
"""Number of frames after which the map is asked again, if it did not know such a frame."""


class LocalizedOutput(NamedTuple):
    """The output of the tracker for a frame after localization in the map.

    Attributes:
        output: Output of the tracker, with the pose from the map if there is one.
        num_matched: Number of map points that agree with the pose; 0 if the frame was not localized.
        recognized: Pose at which a lost frame was relocalized; `None` if it was not.
    """

    output: TrackOutput
    num_matched: int = 0
    recognized: AnchoredPose | None = None


class TrackedAgain(NamedTuple):
    """A lost frame that was tracked after all.

    Attributes:
        flow: Points followed into the frame.
        output: Output of the tracker.
    """

    flow: FlowResult
    output: TrackOutput


class _Attempt(NamedTuple):
    """An attempt to track a lost frame, which may have failed.

    Attributes:
        T_last_cam: `(7,)` motion from which its points were followed.
        again: The points and the output.
        state: State of the tracker after it.
    """

    T_last_cam: Pose
    again: TrackedAgain
    state: TrackState


class LocalizationStage:
    """Relocalizes frames that are lost, and matches frames that are weak with the local map.

    The order of calls for a frame is `track_again` if it is lost, `localize`, then `frame_tracked` or
    `frame_lost`.
    """

    def __init__(
        self, tracker: Tracker, back_end: BackEnd, programs: ProgramCompiler, config: Config, *, localize_only: bool
    ) -> None:
        """Start before the first frame.

        Args:
            tracker: Tracker, whose state moves to the pose from the map.
            back_end: Owner of the map.
            programs: Compiler of the programs; frames are as the tracker left them until it is done.
            config: Settings in effect.
            localize_only: Begin no submaps where a place is unknown.
        """
        self._tracker, self._back, self._programs = tracker, back_end, programs
        self._match_map, self._restart_after = config.track.match_map, config.track.restart_after
        self._begins_submaps = config.run.on_loss == "submap" and not localize_only
        # Not as arrays of JAX: to compare with one would be compiled in the middle of a run.
        self._fastest = float(tracker.params.max_speed_m_per_s), float(tracker.params.max_turn_rad_per_s)
        self._weak_inliers = config.track.weak_inliers
        self._motion = ConstantVelocity()
        self._outside: Pose | None = None
        """Pose of the latest frame, if it is lost, by the motion that something other than the images measured."""
        self._any_tracked = self._was_lost = False
        self._unknown_for = _PAUSE
        """Frames since the latest one that was matched with the map in vain."""
        self._unrecognized = 0
        """Frames since the last one that was tracked whose place is not in the map."""

    @property
    def lost_s(self) -> float:
        """Time since the last frame that was tracked, in seconds."""
        return self._motion.lost_s

    def predicted(self) -> Float[np.ndarray, "7"]:
        """Predict the pose of the latest frame: as measured outside, else by constant velocity for at most a second."""
        return self._motion.now() if self._outside is None else self._outside

    def track_again(
        self, arrays: FrameArrays, flow: FlowResult, measured: MeasuredMotion | None
    ) -> TrackedAgain | None:
        """Track a lost frame again, from the motion since the last tracked frame that was not predicted.

        The shift of the whole image tells a turn of the camera for 1 ms; if that does not explain the frame, matches of
        features tell any motion for 50.

        Args:
            arrays: The frame.
            flow: Points followed into the frame before, with the predicted pose.
            measured: Motion since the last tracked frame that was measured by something else.

        Returns:
            The points and the output; `None` if the frame stays lost.
        """
        if not self._any_tracked or not self._programs.can_map():
            return None
        predicted = np.asarray(flow.predicted.wxyz_xyz, np.float64)
        T_last_cam = between(self._tracker.last_pose(), predicted)
        by_turn = self._from_turn(arrays, T_last_cam, measured)
        if by_turn is not None and int(by_turn.again.output.status) == TrackStatus.OK:
            self._tracker.state = by_turn.state
            return by_turn.again
        return self._from_features(arrays, T_last_cam, measured, by_turn)

    def _from_turn(self, arrays: FrameArrays, T_last_cam: Pose, measured: MeasuredMotion | None) -> _Attempt | None:
        """Try to track a lost frame if the whole image shifted; the state stays as it was."""
        turn = self._back.localizer.turn_to(arrays, T_last_cam)
        if turn is None:
            return None
        state = self._tracker.copied_state()
        again = self._from_motion(arrays, turn, measured)
        attempt = _Attempt(turn, again, self._tracker.state)
        self._tracker.state = state
        return attempt

    def _from_features(
        self, arrays: FrameArrays, T_last_cam: Pose, measured: MeasuredMotion | None, before: _Attempt | None
    ) -> TrackedAgain | None:
        """Track a lost frame again if its features tell the motion; `None` if it stays lost."""
        back, elapsed_s = self._back, self._tracker.elapsed_s()
        found = back.localizer.motion_to(arrays, T_last_cam)
        if found is None:
            return None
        if before is not None and back.localizer.pixels_apart(found.T_last_cam, before.T_last_cam) < _SAME_START_PX:
            again, self._tracker.state = before.again, before.state
        else:
            again = self._from_motion(arrays, found.T_last_cam, measured)
        # Where two places look alike, few points of optical flow agree with a wrong motion too: 18 did, 2.8 m off.
        status = int(again.output.status)
        if status != TrackStatus.LOST and (found.is_certain or status == TrackStatus.OK):
            return again
        # Nearer points look too different for optical flow: a car at 5 m a frame has 15 of 150 that agree.
        twist = displacement(IDENTITY, found.T_last_cam) / elapsed_s
        if not (found.is_certain and self._is_plausible(twist)):
            return None
        self._tracker.state = back.reset_after_motion(self._tracker.state, found.T_world_cam, twist)
        flow = self._tracker.follow(arrays)
        views = back.count_views(found.T_world_cam)
        return TrackedAgain(flow, self._at_matched_pose(self._restarted(arrays, flow, views), found))

    def _from_motion(self, arrays: FrameArrays, T_last_cam: Pose, measured: MeasuredMotion | None) -> TrackedAgain:
        """Track a lost frame again from another motion `(7,)` than the predicted one."""
        self._tracker.before(arrays)
        flow = self._tracker.follow(arrays, T_last_cam, measured)
        return TrackedAgain(flow, self._tracker.advance(arrays, flow, self._back.wishes))

    def localize(
        self, arrays: FrameArrays, output: TrackOutput, dt_s: float, outside: Pose | None = None
    ) -> LocalizedOutput:
        """Relocalize a frame that is lost, or match one that is weak with the local map, if that is compiled yet.

        Args:
            arrays: The frame.
            output: Output of the tracker for the frame.
            dt_s: Time since the frame before, in seconds.
            outside: `(7,)` pose of a lost frame by the motion that something other than the images measured; `None` if
                it is not known.
        """
        self._outside = outside
        if int(output.status) == TrackStatus.LOST:
            return self._relocalize(arrays, output, dt_s) if self._programs.can_map() else self._not_ready(output)
        disagrees = self._disagrees_with_map(output)
        if (disagrees or self._needs_map_match(output)) and self._programs.can_map():
            state, radii_px = self._tracker.state, WIDE_RADII_PX if disagrees else RADII_PX
            self._tracker.state, output, num_matched = self._back.match_local_map(state, arrays, output, radii_px)
            self._unknown_for = _PAUSE if num_matched else 0
            return LocalizedOutput(output, num_matched)
        return LocalizedOutput(output)

    def frame_tracked(self, T_world_cam: Float[np.ndarray, "7"], twist: Float[np.ndarray, "6"]) -> None:
        """Take in the pose and the velocity of a frame that was tracked."""
        self._any_tracked, self._was_lost, self._unrecognized = True, False, 0
        self._motion.tracked(T_world_cam, twist)

    def frame_lost(self, dt_s: float, correction: Float[np.ndarray, "7"]) -> None:
        """Take in that a frame was lost.

        Args:
            dt_s: Time since the frame before, in seconds.
            correction: Correction of the world `(7,)` that came with the frame.
        """
        self._was_lost = True
        self._motion.lost(dt_s, correction)

    def _needs_map_match(self, output: TrackOutput) -> bool:
        """Tell whether a frame that was tracked is matched with the map too."""
        status = int(output.status)
        chosen = self._match_map == "always" or (self._match_map == "keyframes" and bool(output.keyframe))
        return status == TrackStatus.WEAK or (chosen and status != TrackStatus.STARTED)

    def _disagrees_with_map(self, output: TrackOutput) -> bool:
        """Tell whether keyframes of the map show the view, but hardly any of their points agrees with the pose."""
        self._unknown_for += 1
        # A tracker that looks into no keyframes, as `ngd-published`, cannot tell: 64 mm in a room instead of 2.
        expected = min(int(output.num_inliers), int(output.keyframe_matches.num_sought))
        few = int(output.num_keyframe_matches) < _MIN_SHARE * expected
        if int(output.status) == TrackStatus.STARTED or not few:
            return False
        due = bool(output.keyframe) or self._unknown_for > _PAUSE
        return due and self._back.count_views(pose_of(output)) >= _MIN_VIEWS

    def _not_ready(self, lost: TrackOutput) -> LocalizedOutput:
        """Leave a frame lost, and say so where that it is not relocalized is why."""
        if self._was_lost if self._any_tracked else len(self._back.map.ids):
            lost = lost._replace(reason=np.int32(TrackReason.GETTING_READY))
        return LocalizedOutput(lost)

    def _relocalize(self, arrays: FrameArrays, lost: TrackOutput, dt_s: float) -> LocalizedOutput:
        """Track a lost frame again from where the map recognizes its place, or from the last pose in a new submap."""
        predicted = None
        if self._any_tracked:
            predicted = self._motion.after(dt_s) if self._outside is None else self._outside
        found, unknown = self._back.localizer.relocalize(arrays, predicted)
        self._unrecognized += unknown
        if found is not None:
            twist = self._velocity_to(found.anchored, dt_s)
            self._tracker.state = self._back.reset_at_pose(self._tracker.state, found.anchored, twist)
            views = self._back.count_views(self._back.pose(found.anchored))
            return self._relocalized(self._track_again(arrays, views), found, lost)
        if self._may_begin_submap and self._unrecognized > self._restart_after:
            pose = np.asarray(lost.T_world_cam.wxyz_xyz)
            self._tracker.state = self._back.start_submap(self._tracker.state, pose)
            return LocalizedOutput(self._track_again(arrays))
        # Where the frame before was tracked, that nothing could be followed from it says more.
        if unknown and len(self._back.map.ids) and (self._was_lost or not self._any_tracked):
            lost = lost._replace(reason=np.int32(TrackReason.PLACE_NOT_IN_MAP))
        return LocalizedOutput(lost)

    def _velocity_to(self, recognized: AnchoredPose, dt_s: float) -> Float[np.ndarray, "6"]:
        """Return the mean velocity since the last tracked frame; 0 if that is too long ago, or the place is another."""
        twist = self._motion.velocity_to(self._back.pose(recognized), dt_s)
        same_world = self._any_tracked and self._back.keyframe_submap(recognized.keyframe) == self._back.submap_now
        return twist if same_world and self._is_plausible(twist) else np.zeros(6)

    def _is_plausible(self, twist: Float[np.ndarray, "6"]) -> bool:
        """Tell whether the camera may move at a velocity."""
        return bool((np.linalg.norm(twist.reshape(2, 3), axis=1) < self._fastest).all())

    def _track_again(self, arrays: FrameArrays, num_views: int = 0) -> TrackOutput:
        """Track the frame from the state that was just reset, where this number of keyframes show the view."""
        return self._restarted(arrays, self._tracker.follow(arrays), num_views)

    def _restarted(self, arrays: FrameArrays, flow: FlowResult, num_views: int) -> TrackOutput:
        output = self._tracker.advance(arrays, flow, MapWishes(self._back.wishes.demand, num_views))
        if int(output.status) != TrackStatus.STARTED:
            self._tracker.await_relocalization()  # not to start by itself
        return output

    def _at_matched_pose(self, output: TrackOutput, found: FeatureMotion) -> TrackOutput:
        """Return the output of a frame whose pose is that of its features relative to the last frame."""
        enough = found.num_matched >= self._weak_inliers
        return output._replace(
            status=np.int32(TrackStatus.OK if enough else TrackStatus.WEAK),
            reason=np.int32(TrackReason.NONE if enough else TrackReason.FEW_INLIERS),
            covariance=found.covariance.astype(np.float32),
            num_inliers=np.int32(found.num_matched),
        )

    @staticmethod
    def _relocalized(output: TrackOutput, found: LocalizedPose, lost: TrackOutput) -> LocalizedOutput:
        """Return the output of a relocalized frame.

        The pose from the map stands even if nothing in the frame has a depth from which to track on.

        Args:
            output: Output of the tracker that was reset at the pose.
            found: The pose.
            lost: Output of the tracker before, with the reason for the loss.
        """
        covariance = found.covariance.astype(np.float32)
        output = output._replace(status=TrackStatus.RELOCALIZED, reason=lost.reason, covariance=covariance)
        return LocalizedOutput(output, found.num_matched, found.anchored)

    @property
    def _may_begin_submap(self) -> bool:
        """Whether a place that is not in the map may become a part of it; before the map, the tracker starts itself."""
        return self._begins_submaps and (self._any_tracked or len(self._back.map.ids) > 0)
