"""Points of unknown depth: they wait, are located by a measured depth or by parallax, or are dropped."""

import jax.numpy as jnp
import numpy as np
import pytest
from jaxlie import SE3
from jaxslam_kernels.camera import to_pixels

from jaxslam import Camera, load_config
from jaxslam.sensors.frame_arrays import FrameArrays
from jaxslam.sensors.measurement import Measurements, PreparedFrame, depth_sigma
from jaxslam.tracking.from_config import track_params, track_plan
from jaxslam.tracking.initial_state import init_state
from jaxslam.tracking.point_update import KeptPoints, probation_weights
from jaxslam.tracking.points import TrackedPoints
from jaxslam.tracking.step_context import StepContext
from jaxslam.tracking.unknown_depth import assumed_depth, with_located

CAMERA = Camera(name="test", width=320, height=240, fx=260.0, fy=260.0, cx=159.5, cy=119.5)
CONFIG = load_config("default").track
PARAMS, PLAN = track_params(CAMERA, CONFIG), track_plan(CONFIG)._replace(cues=(), regions=None, motion=None)
N = PLAN.num_points
NUM_WAITING = 40
ASSUMED_M = 2.0
WAITING = np.arange(N) < NUM_WAITING


def scene() -> np.ndarray:
    """`(3, n)` true positions of points 1 to 6 m away, meters."""
    rng = np.random.default_rng(3)
    depth = rng.uniform(1, 6, N)
    return np.stack([rng.uniform(-0.4, 0.4, N) * depth, rng.uniform(-0.3, 0.3, N) * depth, depth])


def located(
    moved_m: tuple[float, float, float],
    *,
    measured_m: np.ndarray | None = None,
    frame_has_depth: bool = False,
    shift_px: float = 0.0,
) -> KeptPoints:
    """Locate points that were detected from the origin, seen now by a camera that has moved.

    Args:
        moved_m: Way of the camera.
        measured_m: `(n,)` measured depths; none if not given.
        frame_has_depth: Whether the frame has depth, if only elsewhere.
        shift_px: Distance upward from where the points should be seen, pixels.
    """
    X = scene()
    state = init_state(CAMERA.height, CAMERA.width, PLAN)
    array = lambda values: jnp.asarray(values, jnp.float32)
    points = state.points._replace(
        X_world=array(X / X[2] * ASSUMED_M), X_anchor=jnp.zeros((3, N)), valid=jnp.asarray(WAITING)
    )
    size = (CAMERA.height, CAMERA.width)
    depth, ignore = jnp.full(size, 3.0 if frame_has_depth else 0.0), jnp.zeros(size, bool)
    frame = FrameArrays(jnp.zeros(size, jnp.uint8), depth, ignore, array(1 / 30), array(0))
    pose = SE3(array([1, 0, 0, 0, *moved_m]))
    now = X - np.array(moved_m)[:, None]
    xy = now[:2] / now[2] - np.array([[0], [shift_px / CAMERA.fy]])
    measured = array(np.zeros(N) if measured_m is None else measured_m)
    seen = Measurements(array(xy), measured, depth_sigma(measured, PARAMS.sensor))
    view = PreparedFrame(frame, state.pyramid, array(1 / 30))
    step = StepContext(state._replace(points=points), view, PARAMS, PLAN)
    none = jnp.zeros(N, bool)
    kept = KeptPoints(points._replace(valid=none), none, none)
    return with_located(kept, step, to_pixels(PARAMS.sensor.intrinsics, seen.xy), seen, jnp.asarray(WAITING), pose)


def test_parallax_tells_the_depth() -> None:
    """Those near enough for the way of the camera are located exactly; the others wait at the first ray."""
    points, X = located((0.15, 0.05, 0.0)).points, scene()
    has_position = np.asarray(points.has_position()) & WAITING
    assert 10 <= has_position.sum() <= 38
    assert np.median(X[2, has_position]) < np.median(X[2, WAITING & ~has_position])
    np.testing.assert_allclose(points.X_world[:, has_position], X[:, has_position], rtol=1e-3, atol=1e-3)
    np.testing.assert_array_equal(points.X_anchor[:, has_position], points.X_world[:, has_position])
    np.testing.assert_array_equal(points.valid, WAITING)
    # Farther points are less sure, for the same way of the camera.
    sigma_m = 1 / np.sqrt(np.asarray(points.information)[has_position])
    assert (sigma_m < 0.11 * X[2, has_position]).all()
    assert np.corrcoef(sigma_m, X[2, has_position] ** 2)[0, 1] > 0.9


def test_they_wait_while_the_camera_rests() -> None:
    points = located((0.0, 0.0, 0.0)).points
    np.testing.assert_array_equal(points.valid, WAITING)
    assert not points.has_position().any()
    assert not probation_weights(points, PARAMS).any()


def test_what_the_first_ray_cannot_explain_is_dropped() -> None:
    assert not located((0.15, 0.0, 0.0), shift_px=6.0).points.valid.any()
    assert not located((0.0, 0.0, 0.0), shift_px=6.0).points.valid.any()


def test_measured_depth_comes_first() -> None:
    X = scene()
    measured_m = np.where(np.arange(N) < 25, X[2], 0)
    points = located((0.0, 0.0, 0.0), measured_m=measured_m, frame_has_depth=True).points
    np.testing.assert_array_equal(points.valid, WAITING)  # the others lie where the frame has no depth
    np.testing.assert_array_equal(points.has_position(), np.arange(N) < 25)
    np.testing.assert_allclose(points.X_world[:, :25], X[:, :25], rtol=1e-5)
    np.testing.assert_allclose(
        points.information[:25], 1 / depth_sigma(points.depth[:25], PARAMS.sensor) ** 2, rtol=1e-5
    )
    np.testing.assert_allclose(points.depth[:25], X[2, :25], rtol=1e-6)


def test_other_points_stay_as_they_are() -> None:
    points = located((0.15, 0.05, 0.0)).points
    assert not points.valid[NUM_WAITING:].any()
    assert not points.has_position()[NUM_WAITING:].any()


@pytest.mark.parametrize(("known", "expected_m"), [(True, 3.0), (False, PARAMS.sensor.min_depth_m)])
def test_assumed_depth(known: bool, expected_m: float) -> None:
    """The median of the points in front that have a position; the nearest depth there is if there are none."""
    depth_m = jnp.asarray([2.0, 3.0, 4.0, -9.0, 50.0], jnp.float32)
    state = init_state(CAMERA.height, CAMERA.width, PLAN._replace(num_points=5))
    points: TrackedPoints = state.points._replace(
        X_world=jnp.zeros((3, 5)).at[2].set(depth_m),
        valid=jnp.asarray([True, True, True, True, False]),
        information=jnp.full(5, 1.0 if known else 0.0),
    )
    assert assumed_depth(points, state.T_world_cam, PARAMS.sensor.min_depth_m) == pytest.approx(float(expected_m))
