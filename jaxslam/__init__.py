"""jaxslam: differentiable, real-time visual SLAM for dynamic scenes, on a plain CPU.

The public index. `Slam` is for robots and recordings, `track_step` for gradients and batches.

Each name is imported from its module when it is first used, so `import jaxslam` itself costs next to nothing.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
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
    from jaxslam.step_input import FrameArrays as FrameArrays
    from jaxslam.step_input import frame_arrays as frame_arrays
    from jaxslam.step_input import stack_frames as stack_frames
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

_NAMES_OF_MODULE = {
    "jaxslam_kernels.camera": ("Intrinsics",),
    "jaxslam_kernels.lk_flow": ("FlowPlan", "LevelPlan"),
    "jaxslam_kernels.pose_refine": ("PoseStatus",),
    "jaxslam.batch": ("track_clips",),
    "jaxslam.camera": ("Camera", "known_cameras"),
    "jaxslam.config": ("Config", "load_config"),
    "jaxslam.datasets": ("open_dataset",),
    "jaxslam.dynamics.cue": ("Scene", "Verdict", "judge"),
    "jaxslam.dynamics.known": ("with_cue_params", "with_cues"),
    "jaxslam.errors": ("JaxSlamError",),
    "jaxslam.evaluation": ("Evaluation", "evaluate"),
    "jaxslam.frame": ("Frame",),
    "jaxslam.step_input": ("FrameArrays", "frame_arrays", "stack_frames"),
    "jaxslam.rectification": ("RectifiedPair",),
    "jaxslam.rig": ("Lens", "Rig"),
    "jaxslam.slam": ("Slam",),
    "jaxslam.state": (
        "KeyframeReason",
        "TrackedPoints",
        "TrackOutput",
        "TrackParams",
        "TrackPlan",
        "TrackReason",
        "TrackState",
        "TrackStatus",
    ),
    "jaxslam.track": ("Followed", "follow_points", "init_state", "track_followed", "track_step"),
    "jaxslam.track_settings": ("track_params", "track_plan"),
    "jaxslam.tracked": ("Tracked",),
    "jaxslam.trajectory": ("Trajectory",),
    "jaxslam.xla": ("enable_compile_cache", "prefer_one_thread"),
}
_MODULE_OF = {name: module for module, names in _NAMES_OF_MODULE.items() for name in names}
__all__ = [*_MODULE_OF]  # noqa: PLE0604 # pyright: ignore[reportUnsupportedDunderAll] - strings, of the table


def __getattr__(name: str) -> Any:
    """Import a public name from its module (PEP 562), and keep it for the next time."""
    if name not in _MODULE_OF:
        raise AttributeError(f"module 'jaxslam' has no attribute '{name}'", name=name, obj=import_module(__name__))
    value = getattr(import_module(_MODULE_OF[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    """The public names."""
    return sorted([*__all__, "__version__"])
