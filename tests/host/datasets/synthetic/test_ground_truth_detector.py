"""The detector that knows the synthetic scene."""

import dataclasses

import numpy as np
import pytest

from jaxslam.datasets.synthetic import SceneDetector, SyntheticConfig, SyntheticDataset
from jaxslam.errors import ConfigError, DatasetError
from jaxslam.masks.box_to_mask import mask_of_detections

SMALL = SyntheticConfig(width=96, height=72, frames=6, people=2, boxes=1)


@pytest.fixture(scope="module")
def room() -> SyntheticDataset:
    return SyntheticDataset(SMALL)


class Rendered:
    """Counts how often frames are rendered."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.indices: list[int] = []
        render = SyntheticDataset.render
        monkeypatch.setattr(SyntheticDataset, "render", lambda room, i: (self.indices.append(i), render(room, i))[1])


@pytest.mark.slow
def test_mask_of_every_frame_in_any_order(room: SyntheticDataset) -> None:
    detector = SceneDetector(room)
    for index in (4, 0, 5, 4, 1):
        frame = room.render(index)
        found = detector(frame.rgb)
        mask = mask_of_detections(found, frame.depth_m, room.camera.fx, dilate_px=0)
        np.testing.assert_array_equal(mask, frame.instance_mask > 0)
        assert mask.any()


def test_every_actor_has_its_own(room: SyntheticDataset) -> None:
    frame = room.render(0)
    found = SceneDetector(room)(frame.rgb)
    assert found.masks is not None
    areas = found.masks.sum(axis=(1, 2))
    assert (np.diff(areas) <= 0).all()
    numbers = [int(frame.instance_mask[mask][0]) for mask in found.masks]
    assert sorted(numbers) == np.unique(frame.instance_mask[frame.instance_mask > 0]).tolist()
    for number, mask, label, box in zip(numbers, found.masks, found.labels, found.boxes.astype(int), strict=True):
        np.testing.assert_array_equal(mask, frame.instance_mask == number)
        assert label == ("person" if number <= 2 else "box")
        left, top, right, bottom = box
        assert mask[top:bottom, left:right].sum() == mask.sum()
        assert mask[top, left:right].any()
        assert mask[bottom - 1, left:right].any()
        assert mask[top:bottom, left].any()
        assert mask[top:bottom, right - 1].any()
    np.testing.assert_array_equal(found.scores, 1)


@pytest.mark.parametrize("label", ["person", "box"])
def test_some_labels(label: str) -> None:
    room = SyntheticDataset(dataclasses.replace(SMALL, people=1, boxes=2))
    detector = SceneDetector(room, labels=(label,))
    frames = [room.render(index) for index in range(len(room))]
    found = [detector(frame.rgb) for frame in frames]
    assert {name for one in found for name in one.labels} == {label}
    for one, frame in zip(found, frames, strict=True):
        numbers = (1,) if label == "person" else (2, 3)
        mask = mask_of_detections(one, frame.depth_m, room.camera.fx, dilate_px=0)
        np.testing.assert_array_equal(mask, np.isin(frame.instance_mask, numbers))


def test_people_who_sit_are_people() -> None:
    room = SyntheticDataset(dataclasses.replace(SMALL, people=1, boxes=1, seated=2))
    frame = room.render(0)
    found = SceneDetector(room)(frame.rgb)
    assert found.masks is not None
    named = {int(frame.instance_mask[mask][0]): label for mask, label in zip(found.masks, found.labels, strict=True)}
    assert named == {number: "box" if number == 2 else "person" for number in np.unique(frame.instance_mask)[1:]}
    assert {3, 4} <= named.keys()


def test_nobody_there() -> None:
    room = SyntheticDataset(dataclasses.replace(SMALL, people=0, boxes=0))
    found = SceneDetector(room)(room[0].image)
    assert len(found.boxes) == 0
    assert found.masks is None
    assert found.class_mask is None


def test_a_frame_is_rendered_once(room: SyntheticDataset, monkeypatch: pytest.MonkeyPatch) -> None:
    images = [room[index].image for index in range(4)]
    rendered = Rendered(monkeypatch)
    detector = SceneDetector(room)
    for image in (images[0], images[2], images[2], images[1]):
        detector(image)
    assert rendered.indices == [0, 1, 2]


def test_what_is_rendered_already_is_not_again(room: SyntheticDataset, monkeypatch: pytest.MonkeyPatch) -> None:
    frames = [room.render(index) for index in (0, 1, 3)]
    image = room[4].image
    rendered = Rendered(monkeypatch)
    detector = SceneDetector(room, frames)
    for frame in frames:
        mask = mask_of_detections(detector(frame.rgb), frame.depth_m, room.camera.fx, dilate_px=0)
        np.testing.assert_array_equal(mask, frame.instance_mask > 0)
    assert rendered.indices == []
    detector(image)
    assert rendered.indices == [2, 4]


class TestOtherImages:
    def test_of_another_recording(self, room: SyntheticDataset) -> None:
        other = SyntheticDataset(dataclasses.replace(SMALL, seed=1))
        detector = SceneDetector(room)
        for _ in range(2):
            with pytest.raises(DatasetError, match=r"one of the 6 frames of synthetic_xyz_2people_1boxes_seed0"):
                detector(other[0].image)
        assert detector(room[3].image).masks is not None

    def test_one_value_is_another(self, room: SyntheticDataset) -> None:
        image = room[0].image.copy()
        image[3, 4, 1] ^= 1
        with pytest.raises(DatasetError, match=r"got another of shape \(72, 96, 3\)"):
            SceneDetector(room)(image)

    def test_of_another_size(self, room: SyntheticDataset, monkeypatch: pytest.MonkeyPatch) -> None:
        """Nothing need be rendered to know that."""
        rendered = Rendered(monkeypatch)
        with pytest.raises(DatasetError, match=r"\(96, 72, 3\)"):
            SceneDetector(room)(np.zeros((96, 72, 3), np.uint8))
        assert not rendered.indices


def test_unknown_label(room: SyntheticDataset) -> None:
    with pytest.raises(ConfigError, match=r"labels: expected classes .*got 'persson'.*did you mean 'person'"):
        SceneDetector(room, labels=("persson",))
