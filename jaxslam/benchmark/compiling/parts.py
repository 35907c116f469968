"""The parts of jaxslam whose programs `jaxslam bench compile` measures, each compiled as the product compiles it."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import TypeAlias

import jax
import numpy as np

from jaxslam.config.loading import load_config
from jaxslam.config.schema import Config
from jaxslam.datasets.synthetic import SyntheticConfig, SyntheticDataset
from jaxslam.dense.dense_map import DenseMap
from jaxslam.features.view_matching import compile_view_matching
from jaxslam.loop_closing.essential_graph import compile_graph
from jaxslam.mapping.local_mapping import LocalMapping, mapping_plan
from jaxslam.runtime.compiler_options import FAST_COMPILE
from jaxslam.sensors.camera import Camera
from jaxslam.sensors.frame import Frame
from jaxslam.sensors.frame_arrays import FrameArrays, FrameMemory, frame_arrays
from jaxslam.slam.tracker import MapWishes, Tracker
from jaxslam.tracking.from_config import track_params, track_plan
from jaxslam.tracking.initial_state import init_state
from jaxslam.tracking.state import TrackParams, TrackState
from jaxslam.tracking.step import follow_points, track_step

_GRADIENT_SETTINGS = ("track.cell_px=10", "track.num_levels=3")
"""Those of the example in `docs/gradients-and-batches.md`."""

Compile: TypeAlias = Callable[[], object]
"""Function that compiles the programs of a part; everything before it has been prepared."""


@dataclass(frozen=True)
class Scene:
    """Camera, settings and images for which programs are compiled.

    Attributes:
        camera: Camera of the frames.
        config: Settings.
        gradient_size: Width and height of the images that the gradient is taken of, pixels.
    """

    camera: Camera
    config: Config
    gradient_size: tuple[int, int]

    def blank_frame(self) -> FrameArrays:
        """Return the arrays of a black frame without depth."""
        shape = (self.camera.height, self.camera.width)
        black, pairs = np.zeros(shape, np.uint8), self.camera.is_stereo
        memory = FrameMemory(*shape, pairs=pairs)
        return memory.hold(Frame(0, black, np.zeros(shape, np.float32), right=black if pairs else None), 0.0)

    def tracker(self) -> Tracker:
        """Return a tracker before its first frame."""
        tracker = Tracker(self.camera, self.config)
        tracker.begin(await_relocalization=False)
        return tracker


def _flow(scene: Scene) -> Compile:
    tracker, frame = scene.tracker(), scene.blank_frame()
    return lambda: tracker.follow(frame)


def _step(scene: Scene) -> Compile:
    tracker, frame = scene.tracker(), scene.blank_frame()
    shapes = jax.eval_shape(partial(follow_points, plan=tracker.plan), tracker.state, frame, tracker.params)
    followed = jax.tree.map(lambda of: np.zeros(of.shape, of.dtype), shapes)
    return lambda: tracker.advance(frame, followed, MapWishes())


def _gradient(scene: Scene) -> Compile:
    width, height = scene.gradient_size
    room = SyntheticDataset(SyntheticConfig(frames=1, width=width, height=height))
    settings = load_config(overrides=_GRADIENT_SETTINGS).track
    params, plan = track_params(room.camera, settings), track_plan(settings)
    black = Frame(0, np.zeros((height, width), np.uint8), np.zeros((height, width), np.float32))

    def forward_m(params: TrackParams, state: TrackState, frame: FrameArrays) -> jax.Array:
        return track_step(state, frame, params, plan)[1].T_world_cam.translation()[2]

    inputs = params, init_state(height, width, plan), frame_arrays(black, dt_s=1 / 30)
    return lambda: jax.jit(jax.value_and_grad(forward_m), compiler_options=FAST_COMPILE).lower(*inputs).compile()


def _mapping(scene: Scene) -> Compile:
    tracker, frame = scene.tracker(), scene.blank_frame()
    plan = tracker.plan
    mapping = LocalMapping(scene.camera, tracker.params.sensor, mapping_plan(scene.camera, scene.config))
    return partial(mapping.compile, frame, plan.num_points + plan.num_sources * plan.points_per_source)


def _loop_closing(scene: Scene) -> Compile:
    sensor, plan = scene.tracker().params.sensor, mapping_plan(scene.camera, scene.config)

    def compile_both() -> None:
        compile_graph()
        compile_view_matching(sensor, plan.features)

    return compile_both


def _dense(scene: Scene) -> Compile:
    sensor = scene.tracker().params.sensor
    nearest_m, farthest_m = float(sensor.min_depth_m), float(sensor.max_depth_m)
    return DenseMap(scene.camera, scene.config.dense, nearest_m=nearest_m, farthest_m=farthest_m).compile


PARTS: dict[str, Callable[[Scene], Compile]] = {
    "flow": _flow,
    "step": _step,
    "gradient": _gradient,
    "mapping": _mapping,
    "loop-closing": _loop_closing,
    "dense": _dense,
}
"""Functions that prepare the parts, by name."""
