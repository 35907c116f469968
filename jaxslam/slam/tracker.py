"""The compiled tracker of one camera: its settings, its state, and the programs that advance it by a frame."""

import gc
from concurrent.futures import ThreadPoolExecutor
from enum import Enum
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxlie import SE3
from jaxslam_kernels.pose.pose_cost import PosePrior
from jaxslam_kernels.se3 import between, compose
from jaxslam_kernels.types import Flag
from jaxtyping import Array, Float

from jaxslam.config.schema import Config
from jaxslam.geometry.se3 import IDENTITY
from jaxslam.geometry.types import Pose
from jaxslam.runtime.compiled import committed, compiled, lower
from jaxslam.runtime.compiler_options import FAST_COMPILE
from jaxslam.runtime.garbage import collector_paused
from jaxslam.sensors.camera import Camera
from jaxslam.sensors.frame_arrays import FrameArrays
from jaxslam.slam.outside_motion import MeasuredMotion
from jaxslam.tracking.cue_registry import with_cue_params, with_cues
from jaxslam.tracking.from_config import track_params, track_plan, with_dense_keyframes
from jaxslam.tracking.initial_state import init_state
from jaxslam.tracking.state import TrackOutput, TrackParams, TrackPhase, TrackPlan, TrackState, TrackStatus
from jaxslam.tracking.step import FlowResult, follow_points, predicted_pose, track_followed

_PATIENT_S = 0.5
"""Seconds from one keyframe to the next for want of points, while mapping is behind. With the preset `ngd` at the rate
of the camera there was one every tenth of a second, and the threads held each other up."""
_NO_INFORMATION: Any = np.zeros((6, 6), np.float32)
_ALL_IS_NEW = 2.0
"""More than the whole of a keyframe's points: a frame that shows them all is kept too."""


class _KnownMotion(NamedTuple):
    """Known parts of the motion since the last tracked frame.

    Attributes:
        T_last_cam: `(7,)` pose of the camera in the axes of the last tracked frame.
        has_rotation: Whether its rotation is known.
        has_translation: Whether its translation is known.
    """

    T_last_cam: Float[Array, "7"]
    has_rotation: Flag
    has_translation: Flag


def _known_motion(T_last_cam: Pose | None, *, translation: bool = True) -> _KnownMotion:
    known: Any = (np.bool_(T_last_cam is not None), np.bool_(T_last_cam is not None and translation))
    motion: Any = (IDENTITY if T_last_cam is None else T_last_cam).astype(np.float32)
    return _KnownMotion(motion, *known)


@compiled(when="warm-up", static="plan", options=FAST_COMPILE)
def _follow_points(
    state: TrackState,
    frame: FrameArrays,
    motion: _KnownMotion,
    measured: _KnownMotion,
    information: Float[Array, "6 6"],
    params: TrackParams,
    plan: TrackPlan,
) -> FlowResult:
    """Follow points from a motion since the last frame, or where that is not known, from one that was measured outside.

    What is not known of either comes from the velocity.
    """
    own = predicted_pose(state, frame.dt_s)
    outside = _moved(state.T_world_cam, measured, own)
    predicted = SE3(jnp.where(motion.has_rotation, _moved(state.T_world_cam, motion, own).wxyz_xyz, outside.wxyz_xyz))
    is_known = motion.has_rotation | measured.has_rotation
    prior = PosePrior(outside, information)
    return follow_points(state, frame, params, plan, predicted=predicted, prior=prior, is_known=is_known)


def _moved(T_world_last: SE3, motion: _KnownMotion, own: SE3) -> SE3:
    """Return the pose after a motion; what is not known of it is that of another pose."""
    given, moved = SE3(motion.T_last_cam), between(T_world_last, own)
    # A rotation alone says how the camera points; from where, the velocity says.
    shift = jnp.where(motion.has_translation, given.translation(), moved.translation())
    parts = jnp.concatenate([given.wxyz_xyz[:4], shift])
    return SE3(jnp.where(motion.has_rotation, compose(T_world_last, SE3(parts)).wxyz_xyz, own.wxyz_xyz))


@compiled(when="warm-up", static="plan", donate="state", options=FAST_COMPILE)
def _track_followed(
    state: TrackState, frame: FrameArrays, followed: FlowResult, params: TrackParams, plan: TrackPlan
) -> tuple[TrackState, TrackOutput]:
    """Estimate the pose of a frame and update the state but for its pyramid, which neither state has.

    The caller chooses that of the frame or the one before: the program would copy one of them, 0.1 ms.
    """
    state, output = track_followed(state._replace(pyramid=followed.pyramid), frame, followed, params, plan)
    return _without_pyramid(state), output


def _without_pyramid(state: TrackState) -> TrackState:
    nothing: Any = None
    return state._replace(pyramid=nothing)


class KeyframeDemand(Enum):
    """Demand of the maps for a frame as a keyframe."""

    NORMAL = "normal"
    """A keyframe is made for the reasons in the settings."""
    FEWER = "fewer"
    """Less than that, since mapping is behind."""
    NOW = "now"
    """In any case, since the dense map lacks what the frame shows."""


class MapWishes(NamedTuple):
    """Wishes of the maps for the next frame.

    Attributes:
        demand: How much they want it to be a keyframe.
        num_views: Number of keyframes of the map that show the view.
        has_changed: Whether many points of the map are gone, and no keyframe was made since.
    """

    demand: KeyframeDemand = KeyframeDemand.NORMAL
    num_views: int = 0
    has_changed: bool = False


class Tracker:
    """Advances the state of tracking frame by frame; starts no submap by itself, except at the first frame.

    Attributes:
        params: Settings that are traced.
        plan: Settings that are compiled in.
        state: State after the latest frame, from `begin` on. Programs that change it take it over (its buffers are
            donated).
    """

    state: TrackState

    def __init__(self, camera: Camera, config: Config) -> None:
        """Prepare the settings; `begin` makes the state.

        Args:
            camera: Camera that takes the frames.
            config: Settings in effect.
        """
        params = track_params(camera, with_dense_keyframes(config))._replace(restart_after=jnp.float32(jnp.inf))
        self.params = with_cue_params(params, config.dynamics)
        self.plan = with_cues(track_plan(config.track), config.dynamics, pairs=camera.is_stereo)
        if camera.is_stereo:  # along a road, neighbors at other depths move far apart; for brightness see FlowPlan
            self.plan = self.plan._replace(flow=self.plan.flow._replace(seeds=0, ignores_brightness=False))
        # ORB-SLAM's local mapping does not accept keyframes either while it is busy.
        patient_s = max(_PATIENT_S, config.track.keyframe_weak_after_s)
        self._params_for = {
            KeyframeDemand.NORMAL: self.params,
            KeyframeDemand.FEWER: self.params._replace(keyframe_weak_after_s=jnp.float32(patient_s)),
            KeyframeDemand.NOW: self.params._replace(keyframe_below=jnp.float32(_ALL_IS_NEW)),
        }
        self._height, self._width, self._seed = camera.height, camera.width, config.run.seed

    def fresh_state(self) -> TrackState:
        """Return a state before the first frame."""
        # Committed from the beginning, as after any `cached_trace`: else all is compiled again when the first one is.
        return committed(init_state(self._height, self._width, self.plan, seed=self._seed))

    def begin(self, *, await_relocalization: bool) -> None:
        """Forget all frames.

        Args:
            await_relocalization: Stay lost until the place of a frame is recognized, instead of starting at the next.
        """
        self.state = self.fresh_state()
        if await_relocalization:
            self.await_relocalization()

    def await_relocalization(self) -> None:
        """Stay lost until the place of a frame is recognized."""
        # Where the others are: with `jnp.zeros`, which is on no device for certain, the step was compiled anew.
        phase = jax.device_put(np.int32(TrackPhase.LOST), *self.state.twist.devices())
        self.state = self.state._replace(phase=phase)

    def recover(self) -> None:
        """Begin anew, awaiting relocalization, if an interrupted step took the state along."""
        if any(leaf.is_deleted() for leaf in jax.tree.leaves(self.state)):
            self.begin(await_relocalization=True)

    def compile(self, frame: FrameArrays) -> None:
        """Compile the programs for frames like this one; the state stays as it is."""
        state, other = self.fresh_state(), self.fresh_state()
        # As `_follow_points` returns it: with NumPy's array the step was compiled anew for the first frame.
        prior = PosePrior(other.T_world_cam, committed(jnp.asarray(_NO_INFORMATION)))
        followed = FlowResult(other.pyramid, other.T_world_cam, other.points.uv, other.points.valid, prior)
        # In two threads: XLA compiles one while Python traces the other, 1.2 s less from an empty cache. The step
        # takes longer: it is lowered before, as Python traces one program at a time.
        with collector_paused(), ThreadPoolExecutor(1, thread_name_prefix="jaxslam-compile-flow") as beside:
            lower(_track_followed, _without_pyramid(state), frame, followed, self.params, self.plan)
            nothing = _known_motion(None), _known_motion(None), _NO_INFORMATION
            flow = beside.submit(_follow_points, other, frame, *nothing, self.params, self.plan)
            beside.submit(gc.collect)  # while XLA compiles the step; the second frame would wait for it, 0.2 s
            jax.block_until_ready(_track_followed(_without_pyramid(state), frame, followed, self.params, self.plan))
            jax.block_until_ready(flow.result())

    def follow(
        self, frame: FrameArrays, T_last_cam: Pose | None = None, measured: MeasuredMotion | None = None
    ) -> FlowResult:
        """Follow the points of the state into a frame by optical flow.

        Args:
            frame: The frame.
            T_last_cam: `(7,)` pose of the camera in the axes of the last tracked frame, from which points are followed;
                predicted from the velocity if it is not known.
            measured: Motion since the last tracked frame that was measured by something else; a term of the pose, and
                the prediction if there is no other.
        """
        outside, information = _known_motion(None), _NO_INFORMATION
        if measured is not None:
            prior = measured.prior
            outside = _known_motion(prior.T_last_cam, translation=prior.has_translation)
            information = measured.information.astype(np.float32)
        motion = _known_motion(T_last_cam)
        return _follow_points(self.state, frame, motion, outside, information, self.params, self.plan)

    def last_pose(self) -> Pose:
        """Return the pose `(7,)` of the last tracked frame."""
        return np.asarray(self.state.T_world_cam.wxyz_xyz, np.float64)

    def elapsed_s(self) -> float:
        """Return the time since the last tracked frame, in seconds."""
        return float(np.asarray(self.state.elapsed_s))

    def copied_state(self) -> TrackState:
        """Return a copy of the state, as of before an attempt; `advance` takes the memory of the state over."""
        state = _without_pyramid(self.state)
        copied = jax.device_put(state, *self.state.twist.devices(), may_alias=False)
        return copied._replace(pyramid=self.state.pyramid)

    def before(self, frame: FrameArrays) -> None:
        """Go back in time to before a frame that was lost, so that it can be tracked again."""
        dt_s, devices = np.float32(frame.dt_s), self.state.twist.devices()
        times = (self.state.elapsed_s, self.state.since_keyframe_s)
        elapsed_s, since_keyframe_s = (jax.device_put(np.asarray(time) - dt_s, *devices) for time in times)
        self.state = self.state._replace(elapsed_s=elapsed_s, since_keyframe_s=since_keyframe_s)

    def advance(self, frame: FrameArrays, followed: FlowResult, wishes: MapWishes) -> TrackOutput:
        """Estimate the pose of a frame and update the state.

        Args:
            frame: The frame.
            followed: Result of `follow` for it.
            wishes: What the maps want of the frame.

        Returns:
            Output of the tracker, in NumPy arrays.
        """
        params = self._params_for[wishes.demand]
        if wishes.demand is not KeyframeDemand.NOW:
            views, changed = np.float32(wishes.num_views), np.float32(wishes.has_changed)
            params = params._replace(map_views=views, map_changed=changed)
        pyramid = self.state.pyramid
        state, output = _track_followed(_without_pyramid(self.state), frame, followed, params, self.plan)
        output = jax.tree.map(np.asarray, output)  # as `device_get`, in a tenth of its time
        # A lost frame is no image to follow points from.
        lost = int(output.status) == TrackStatus.LOST
        self.state = state._replace(pyramid=pyramid if lost else followed.pyramid)
        return output
