"""Masks of people with sharp borders, on a made person before a wall."""

import cv2
import numpy as np
import pytest

from jaxslam.worlds.person_mask import filled_depth, refined_mask

SHAPE = (240, 320)


@pytest.fixture
def person() -> np.ndarray:
    """A body with a head."""
    mask = np.zeros(SHAPE, np.uint8)
    cv2.ellipse(mask, (150, 150), (35, 80), 0, 0, 360, 1, -1)
    cv2.circle(mask, (150, 50), 22, 1, -1)
    return mask.view(bool)


def scene(person: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Depth and image: a blue person at 2 m, a gray wall at 4 m, noise, and a seam without depth."""
    rng = np.random.default_rng(0)
    depth_m = np.where(person, 2.0, 4.0).astype(np.float32) + rng.normal(0, 0.01, SHAPE).astype(np.float32)
    depth_m[np.roll(person, -5, axis=1) & ~person] = 0
    image = np.where(person[..., None], (30, 40, 120), (170, 170, 165)) + rng.normal(0, 6, (*SHAPE, 3))
    return depth_m, np.clip(image, 0, 255).astype(np.uint8)


def grown(mask: np.ndarray, radius: int) -> np.ndarray:
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1,) * 2)
    return cv2.dilate(mask.view(np.uint8), kernel).view(bool)


def shrunk(mask: np.ndarray, radius: int) -> np.ndarray:
    return ~grown(~mask, radius)


def iou(first: np.ndarray, second: np.ndarray) -> float:
    return float((first & second).sum() / (first | second).sum())


@pytest.mark.parametrize("rough", ["large", "small", "shifted"])
def test_borders_are_found(person, rough):
    given = {"large": grown(person, 6), "small": shrunk(person, 5), "shifted": np.roll(person, 6, axis=1)}[rough]
    refined = refined_mask(given, *scene(person))
    inner = shrunk(person, 2)
    assert iou(refined, inner) > 0.95 > iou(given, inner)
    assert not (refined & ~grown(person, 1)).any()


def test_depth_alone_finds_them_where_colors_are_alike(person):
    depth_m, _ = scene(person)
    refined = refined_mask(grown(person, 6), depth_m, np.full((*SHAPE, 3), 120, np.uint8))
    assert iou(refined, shrunk(person, 2)) > 0.9


def test_color_alone_finds_them_where_there_is_no_depth(person):
    _, image = scene(person)
    refined = refined_mask(grown(person, 6), np.zeros(SHAPE, np.float32), image)
    assert iou(refined, shrunk(person, 2)) > 0.9


def test_what_is_behind_is_left_out(person):
    """A network that takes a strip of the wall beside a person for a part of it."""
    given = grown(person, 3)
    given[100:200, 150:203] = True
    refined = refined_mask(given, *scene(person))
    assert not (refined & ~grown(person, 1)).any()
    assert iou(refined, shrunk(person, 2)) > 0.95


def test_specks_go_and_small_holes_are_filled(person):
    given = person.copy()
    given[10:30, 280:300] = True
    given[140:146, 145:151] = False
    depth_m, image = scene(person)
    refined = refined_mask(given, depth_m, image)
    assert not refined[:, 260:].any()
    assert refined[135:150, 140:156].all()


def test_nothing_stays_nothing(person):
    none = np.zeros(SHAPE, bool)
    assert not refined_mask(none, *scene(person)).any()
    np.testing.assert_array_equal(filled_depth(none, scene(person)[0]), 0)


def test_missing_depth_is_that_of_the_nearest_pixel(person):
    depth_m = np.where(person, np.linspace(1.5, 2.5, SHAPE[0], dtype=np.float32)[:, None], np.float32(4))
    known, depth_m[120:140] = depth_m.copy(), 0
    filled_m = filled_depth(person, depth_m)
    np.testing.assert_array_equal(filled_m[~person], 0)
    rows = np.r_[40:110, 155:215]
    np.testing.assert_allclose(filled_m[rows][person[rows]], known[rows][person[rows]], atol=0.07)
    np.testing.assert_allclose(filled_m[120:140][person[120:140]], known[120:140][person[120:140]], atol=0.12)


def test_stray_pixels_of_the_background_are_corrected(person):
    depth_m = np.where(person, np.float32(2), np.float32(4))
    depth_m[100:108, 140:148] = 4
    assert (filled_depth(person, depth_m)[person] == 2).all()


def test_a_person_without_depth_is_nearer_than_everything(person):
    both = person.copy()
    both[20:120, 230:290] = True
    depth_m = np.where(person, np.float32(2), np.float32(0))
    filled_m = filled_depth(both, depth_m)
    assert (filled_m[20:120, 230:290] == 0).all()
    assert (filled_m[person] == 2).all()
