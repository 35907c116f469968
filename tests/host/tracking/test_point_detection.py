"""Where new points are detected, and which of them wait for their depth."""

import cv2
import jax.numpy as jnp
import numpy as np
import pytest
from jaxlie import SE3
from jaxslam_kernels.image.pyramid import build_pyramid

from jaxslam import Camera, load_config
from jaxslam.sensors.frame_arrays import FrameArrays
from jaxslam.sensors.measurement import PreparedFrame
from jaxslam.tracking.from_config import track_params, track_plan
from jaxslam.tracking.initial_state import init_state
from jaxslam.tracking.point_detection import detect_new_points
from jaxslam.tracking.step_context import StepContext

WIDTH, HEIGHT = 320, 240
CAMERA = Camera(name="test", width=WIDTH, height=HEIGHT, fx=260.0, fy=260.0, cx=159.5, cy=119.5)
CONFIG = load_config("default").track
PARAMS, PLAN = track_params(CAMERA, CONFIG), track_plan(CONFIG)._replace(cues=(), regions=None, motion=None)
N = PLAN.num_points
EDGE = WIDTH // 2
"""Column at which what lies on the right begins."""
REACH_PX = PLAN.flow.finest.window // 2
"""Half of the window in which points are tracked."""
MOST_WAITING = round(0.5 * (1 - CONFIG.detect_below) * N)


def textured() -> np.ndarray:
    noise = np.random.default_rng(0).uniform(0, 255, (HEIGHT, WIDTH)).astype(np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), 2.0)
    return cv2.normalize(smooth, np.empty_like(smooth), 0, 255, cv2.NORM_MINMAX).astype(np.uint8)


def wall(missing: np.ndarray) -> np.ndarray:
    """Depth image of a wall 2 m away, missing in some columns."""
    return np.broadcast_to(np.where(missing, 0, 2), (HEIGHT, WIDTH)).astype(np.float32)


def detected(
    depth_m: np.ndarray, *, most_waiting: int = MOST_WAITING, num_free: int = N
) -> tuple[np.ndarray, np.ndarray]:
    """Detect points in a textured image.

    Args:
        depth_m: Depth image.
        most_waiting: Largest number of points that wait for their depth.
        num_free: Number of free slots; the other points are in the first cell of the grid.

    Returns:
        Columns of the new points of known depth, and of those that wait, pixels.
    """
    image, time = jnp.asarray(textured()), jnp.float32(1 / 30)
    ignore = jnp.zeros((HEIGHT, WIDTH), bool)
    frame = FrameArrays(image, jnp.asarray(depth_m), ignore, time, jnp.float32(0))
    pyramid = build_pyramid(image, num_levels=PLAN.num_levels, dtype=jnp.float32)
    state = init_state(HEIGHT, WIDTH, PLAN)
    taken = jnp.arange(N) >= num_free
    before = state.points._replace(valid=taken, information=taken.astype(jnp.float32))
    step = StepContext(state, PreparedFrame(frame, pyramid, time), PARAMS, PLAN)
    origin = SE3(jnp.asarray([1, 0, 0, 0, 0, 0, 0], jnp.float32))
    points, _ = detect_new_points(before, step, origin, jnp.zeros(6), most_waiting=most_waiting)
    new, known = np.asarray(points.valid & ~taken), np.asarray(points.has_position())
    columns = np.asarray(points.uv)[0]
    return columns[new & known], columns[new & ~known]


def test_points_out_of_the_sensor_s_reach_wait() -> None:
    known, waiting = detected(wall(np.arange(WIDTH) >= EDGE))
    assert len(known) > 50
    assert known.max() < EDGE
    assert 0.5 * MOST_WAITING < len(waiting) <= MOST_WAITING
    assert waiting.min() > EDGE - 1 + REACH_PX


def test_no_point_waits_beside_measured_depth() -> None:
    """The narrow strip along a silhouette has none for another reason."""
    strip = (np.arange(WIDTH) >= EDGE) & (np.arange(WIDTH) < EDGE + REACH_PX)
    known, waiting = detected(wall(strip))
    assert len(known) > 100
    assert not len(waiting)


@pytest.mark.parametrize("num_free", [20, 60])
def test_known_depth_comes_first(num_free: int) -> None:
    known, waiting = detected(wall(np.arange(WIDTH) >= EDGE), num_free=num_free)
    assert len(known) == num_free
    assert not len(waiting)


def test_none_waits_if_none_may() -> None:
    known, waiting = detected(wall(np.arange(WIDTH) >= EDGE), most_waiting=0)
    assert len(known) > 50
    assert not len(waiting)


def test_all_may_wait_in_a_frame_without_depth() -> None:
    known, waiting = detected(wall(np.ones(WIDTH, bool)), most_waiting=N)
    assert not len(known)
    assert len(waiting) > MOST_WAITING
