"""Real networks on frames with people, and on a street with a parked car: what YOLOX finds, the others find too."""

from pathlib import Path

import numpy as np
import pytest
from real_networks import real_network

from jaxslam.datasets import open_dataset
from jaxslam.semantics import Detections, load_detector
from jaxslam.semantics.class_names import GROUPS
from jaxslam.slam.semantic_thread import rgb_copy

FRAMES = (400, 600, 800)
BOXES = {"nanodet_m_320": "nanodet", "FastestDet": "fastestdet", "yolov8n-seg_int8": "yolov8_seg"}
MAPS = ("deeplabv3_mobilenetv2_voc", "deeplabv3_mobilenetv2_dm05_voc")


def iou(boxes: np.ndarray, others: np.ndarray) -> np.ndarray:
    """`(n, m)` intersection over union."""
    low, high = (pick(boxes[:, None, part], others[None, :, part]) for pick, part in _EDGES)
    shared = np.clip(high - low, 0, None).prod(axis=2)
    areas = [(each[:, 2:] - each[:, :2]).prod(axis=1) for each in (boxes, others)]
    return shared / (areas[0][:, None] + areas[1][None] - shared)


_EDGES = ((np.maximum, slice(0, 2)), (np.minimum, slice(2, 4)))


@pytest.fixture(scope="module")
def images(data_dir: Path) -> list[np.ndarray]:
    folder = data_dir / "bonn" / "rgbd_bonn_crowd"
    if not folder.is_dir():
        pytest.skip(f"JAXSLAM_DATA holds no {folder.name}")
    recording = open_dataset(folder)
    return [recording[number].image for number in FRAMES]


@pytest.fixture(scope="module")
def people(images: list[np.ndarray]) -> list[Detections]:
    detector = load_detector(real_network("yolox_nano"), min_score=0.45)
    assert (detector.adapter, detector.input_size) == ("yolox", (416, 416))
    return [detector(image) for image in images]


def test_yolox(people: list[Detections]) -> None:
    """As many as there are to see: one of four is cut off, and found as two."""
    assert [len(found.boxes) for found in people] == [4, 3, 2]
    assert min(found.scores.max() for found in people) > 0.85


@pytest.mark.parametrize("name", BOXES)
def test_boxes(images: list[np.ndarray], people: list[Detections], name: str) -> None:
    detector = load_detector(real_network(name))
    assert detector.adapter == BOXES[name]
    overlaps = [iou(they.boxes, detector(image).boxes) for image, they in zip(images, people, strict=True)]
    best = np.concatenate([overlap.max(axis=1, initial=0) for overlap in overlaps])
    assert np.mean(best > 0.5) >= 0.75
    assert np.median(best) > 0.8


@pytest.mark.parametrize("name", MAPS)
def test_class_maps(images: list[np.ndarray], people: list[Detections], name: str) -> None:
    """Nearly all of the pixels are inside boxes, and every box has its share of them."""
    detector = load_detector(real_network(name))
    assert (detector.adapter, detector.input_size) == ("class_map", (513, 513))
    for image, they in zip(images, people, strict=True):
        mask = detector(image).class_mask
        assert mask is not None
        inside = np.zeros_like(mask)
        for left, top, right, bottom in np.clip(they.boxes.round().astype(int), 0, None):
            inside[top:bottom, left:right] = True
            assert mask[top:bottom, left:right].mean() > 0.25
        assert mask.shape == image.shape[:2]
        assert np.count_nonzero(mask & inside) > 0.9 * np.count_nonzero(mask)


def test_instance_masks_match_the_class_map(images: list[np.ndarray]) -> None:
    instances, pixels = load_detector(real_network("yolov8n-seg_int8")), load_detector(real_network(MAPS[0]))
    for image in images:
        masks, mask = instances(image).masks, pixels(image).class_mask
        assert masks is not None
        assert mask is not None
        union = masks.any(axis=0)
        assert np.count_nonzero(union & mask) > 0.75 * np.count_nonzero(union | mask)


def test_same_image_same_bytes(images: list[np.ndarray]) -> None:
    first, second = (load_detector(real_network("yolox_nano"))(images[0]) for _ in range(2))
    assert first.boxes.tobytes() == second.boxes.tobytes()
    assert first.scores.tobytes() == second.scores.tobytes()


class TestRoad:
    """A gray image of KITTI 06, in which a parked car fills a quarter of the width."""

    CAR = np.array([[805, 180, 1130, 356]], np.float32)
    """Its box, by hand: left, top, right, bottom, pixels."""

    @pytest.fixture
    def road(self, data_dir: Path) -> np.ndarray:
        folder = data_dir / "kitti" / "sequences" / "06"
        if not folder.is_dir():
            pytest.skip("JAXSLAM_DATA holds no KITTI 06")
        return rgb_copy(open_dataset(folder)[25].image)

    @pytest.mark.parametrize("name", ["yolox_nano", *BOXES])
    def test_boxes_of_vehicles(self, road: np.ndarray, name: str) -> None:
        detector = load_detector(real_network(name), labels=["vehicles"])
        found = detector(road)
        assert set(found.labels) <= set(detector.labels) == set(GROUPS["vehicles"])
        best = int(iou(self.CAR, found.boxes)[0].argmax())
        assert found.labels[best] == "car"
        assert iou(self.CAR, found.boxes)[0, best] > 0.7  # as KITTI counts a car as found

    @pytest.mark.parametrize("name", MAPS)
    def test_pixels_of_vehicles(self, road: np.ndarray, name: str) -> None:
        detector = load_detector(real_network(name), labels=["vehicles"])
        assert detector.missing_labels == ("truck",)
        mask = detector(road).class_mask
        assert mask is not None
        left, top, right, bottom = self.CAR[0].astype(int)
        assert mask[top:bottom, left:right].mean() > 0.6
        mask[top:bottom, left:right] = False
        assert mask.mean() < 0.05
