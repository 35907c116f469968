"""Motion along ways: smooth, at the speed asked for, through the points, and repeating."""

import numpy as np
import pytest

from jaxslam.worlds.description import Route
from jaxslam.worlds.motion import RouteWalk, SmoothWay

SQUARE = ((0.0, 0.0), (3.0, 0.0), (3.0, 3.0), (0.0, 3.0))


@pytest.mark.parametrize("ends", ["back", "loop", "stop"])
def test_position_speed_and_heading_agree(ends):
    way = SmoothWay(SQUARE, 0.8, ends, 1.0)
    time_s, step_s = np.linspace(0.0, way.seconds, 2000), 1e-4
    velocity = (way.position(time_s + step_s) - way.position(time_s - step_s)) / (2 * step_s)
    np.testing.assert_allclose(np.linalg.norm(velocity, axis=1), way.speed(time_s), atol=2e-3)
    straight = way.speed(time_s) > 0.79
    ahead = np.stack([np.cos(way.heading(time_s)), np.sin(way.heading(time_s))], axis=1)
    assert np.all(np.sum(ahead * velocity, axis=1)[straight] > 0.7)
    assert np.max(way.speed(time_s)) < 0.85


@pytest.mark.parametrize("ends", ["back", "loop"])
def test_repeats(ends):
    way = SmoothWay(SQUARE, 0.8, ends, 1.0)
    time_s = np.linspace(0.0, 5.0, 50)
    np.testing.assert_allclose(way.position(time_s), way.position(time_s + 3 * way.seconds), atol=1e-9)
    turned = way.heading(time_s + way.seconds) - way.heading(time_s)
    np.testing.assert_allclose(np.cos(turned), 1.0, atol=1e-9)


def test_acceleration_has_no_steps():
    way = SmoothWay(SQUARE, 0.8, "loop", 0.0)
    time_s = np.linspace(0.0, way.seconds, 20000)
    acceleration = way._positions(time_s, 2)
    steps = np.abs(np.diff(acceleration, axis=0)).max()
    assert steps < 0.05 * np.abs(acceleration).max()


def test_stop_rests_at_the_last_point():
    way = SmoothWay(SQUARE, 0.8, "stop", 0.0)
    late = np.array([way.seconds + 2.0, way.seconds + 100.0])
    np.testing.assert_allclose(way.position(late), [SQUARE[-1]] * 2, atol=1e-6)
    np.testing.assert_array_equal(way.speed(late[1:]), 0.0)


def test_a_pause_is_a_rest_at_the_ends():
    walk = RouteWalk(Route(((0.0, 0.0), (4.0, 0.0)), 1.0, "back", pause_s=4.0))
    at_rest = walk(np.array([2.0]))
    np.testing.assert_allclose(at_rest.position, [[0.0, 0.0]], atol=1e-6)
    np.testing.assert_allclose(at_rest.speed_m_per_s, 0.0, atol=1e-6)
    np.testing.assert_allclose(walk(np.array([10.0])).position, [[4.0, 0.0]], atol=1e-6)


def test_backward_faces_the_other_way():
    ahead, behind = (
        RouteWalk(Route(((0.0, 0.0), (4.0, 0.0)), 1.0, "stop", backward=backward)) for backward in (False, True)
    )
    time_s = np.array([2.0])
    np.testing.assert_allclose(behind(time_s).heading - ahead(time_s).heading, np.pi)
    np.testing.assert_array_equal(behind(time_s).position, ahead(time_s).position)
