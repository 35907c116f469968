"""jaxslam: differentiable, real-time visual SLAM for dynamic scenes, on a plain CPU.

The public index. `Slam` is for robots and recordings, `track_step` for gradients and batches.
"""

from jaxslam_kernels.camera import Intrinsics as Intrinsics
from jaxslam_kernels.lk_flow import FlowPlan as FlowPlan
from jaxslam_kernels.lk_flow import LevelPlan as LevelPlan
from jaxslam_kernels.pose_refine import PoseStatus as PoseStatus

from jaxslam.batch import track_clips as track_clips
from jaxslam.camera import Camera as Camera
from jaxslam.camera import known_cameras as known_cameras
from jaxslam.config import Config as Config
from jaxslam.config import load_config as load_config
from jaxslam.datasets import open_dataset as open_dataset
from jaxslam.dynamics.cue import Scene as Scene
from jaxslam.dynamics.cue import Verdict as Verdict
from jaxslam.dynamics.cue import judge as judge
from jaxslam.dynamics.known import with_cue_params as with_cue_params
from jaxslam.dynamics.known import with_cues as with_cues
from jaxslam.errors import JaxSlamError as JaxSlamError
from jaxslam.evaluation import Evaluation as Evaluation
from jaxslam.evaluation import evaluate as evaluate
from jaxslam.frame import Frame as Frame
from jaxslam.frame_arrays import FrameArrays as FrameArrays
from jaxslam.frame_arrays import frame_arrays as frame_arrays
from jaxslam.frame_arrays import stack_frames as stack_frames
from jaxslam.rectification import RectifiedPair as RectifiedPair
from jaxslam.rig import Lens as Lens
from jaxslam.rig import Rig as Rig
from jaxslam.slam import Slam as Slam
from jaxslam.state import KeyframeReason as KeyframeReason
from jaxslam.state import TrackedPoints as TrackedPoints
from jaxslam.state import TrackOutput as TrackOutput
from jaxslam.state import TrackParams as TrackParams
from jaxslam.state import TrackPlan as TrackPlan
from jaxslam.state import TrackReason as TrackReason
from jaxslam.state import TrackState as TrackState
from jaxslam.state import TrackStatus as TrackStatus
from jaxslam.track import Followed as Followed
from jaxslam.track import follow_points as follow_points
from jaxslam.track import init_state as init_state
from jaxslam.track import track_followed as track_followed
from jaxslam.track import track_step as track_step
from jaxslam.track_settings import track_params as track_params
from jaxslam.track_settings import track_plan as track_plan
from jaxslam.tracked import Tracked as Tracked
from jaxslam.trajectory import Trajectory as Trajectory
from jaxslam.xla import enable_compile_cache as enable_compile_cache
from jaxslam.xla import prefer_one_thread as prefer_one_thread

__version__ = "0.1.0"
