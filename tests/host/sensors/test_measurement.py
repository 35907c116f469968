"""Seeing points through distortion, a rolling shutter and a late depth image, and undoing it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxlie import SE3
from jaxslam_kernels.se3 import retract, to_camera

from jaxslam import Camera
from jaxslam.config.schema import TrackConfig
from jaxslam.sensors.measurement import pixel_rays, predict_pixels
from jaxslam.sensors.sensor_model import sensor_model

TWIST = np.array([0.2, -0.1, 0.15, 0.3, -0.6, 0.4])


@pytest.fixture(scope="module")
def sensor():
    return sensor_model(Camera.load("tum_fr1"), TrackConfig())


@pytest.fixture
def points():
    random = np.random.default_rng(0)
    depth = random.uniform(1, 4, 50)
    return jnp.asarray(
        [random.uniform(-0.35, 0.35, 50) * depth, random.uniform(-0.25, 0.25, 50) * depth, depth], jnp.float32
    )


def test_observing_undoes_predicting(sensor, points):
    twist = jnp.asarray(TWIST, jnp.float32)
    uv = predict_pixels(points, twist, 480, sensor)
    seen = pixel_rays(uv, sensor).measured(points[2], twist, jnp.ones((480, 640), jnp.float32), jnp.float32(0), sensor)
    error = np.abs(np.asarray(seen.xy) - np.asarray(points[:2] / points[2:3])) * 517
    # Second order in the readout time: the prediction looks up the row before the motion, the observation after it.
    assert error.max() < 0.3
    still = pixel_rays(predict_pixels(points, 0 * twist, 480, sensor), sensor).measured(
        points[2], 0 * twist, jnp.ones((480, 640), jnp.float32), jnp.float32(0), sensor
    )
    assert (np.abs(np.asarray(still.xy) - np.asarray(points[:2] / points[2:3])) * 517).max() < 1e-2


def test_a_late_depth_image_is_read_where_the_point_is_then(sensor):
    """A wall with a step in depth, seen from a camera that turns: the depth image of 20 ms later has moved."""
    turn = jnp.asarray([0, 0, 0, 0, -2.0, 0], jnp.float32)
    global_shutter = sensor._replace(
        readout_s=jnp.float32(0), intrinsics=sensor.intrinsics._replace(distortion=jnp.zeros(5, jnp.float32))
    )
    X = jnp.asarray([[-0.02], [0.0], [2.0]], jnp.float32)  # left of the step, by 5 pixels
    later = retract(SE3.identity(), turn * 0.02)
    edge = float(
        predict_pixels(
            to_camera(later, jnp.asarray([[0.0], [0.0], [2.0]], jnp.float32)), 0 * turn, 480, global_shutter
        )[0, 0]
    )
    depth = np.full((480, 640), 2.0, np.float32)
    depth[:, int(np.ceil(edge)) :] = 4.0
    uv = predict_pixels(X, 0 * turn, 480, global_shutter)
    read = lambda delay: float(
        pixel_rays(uv, global_shutter)
        .measured(X[2], turn, jnp.asarray(depth), jnp.float32(delay), global_shutter, reach=0)
        .depth[0]
    )
    assert edge > float(uv[0, 0]) + 10  # the scene moves right while the camera turns left
    assert read(0.02) == 2.0
    beyond = X.at[0, 0].set(0.02)
    uv = predict_pixels(beyond, 0 * turn, 480, global_shutter)
    assert read(0.02) == 4.0
    assert read(0.0) == 2.0  # what ignoring the delay would give: the near side


def test_gradient_reaches_the_camera(sensor, points):
    def loss(focal, readout):
        changed = sensor._replace(intrinsics=sensor.intrinsics._replace(fx=focal), readout_s=readout)
        return jnp.sum(predict_pixels(points, jnp.asarray(TWIST, jnp.float32), 480, changed))

    gradient = jax.grad(loss, argnums=(0, 1))(sensor.intrinsics.fx, sensor.readout_s)
    assert all(np.isfinite(g) and abs(g) > 0 for g in gradient)
