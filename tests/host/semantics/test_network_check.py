"""Good networks are told from bad ones by what they find in pictures with known content."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import tiny_segmenters
from real_networks import real_network

from jaxslam.semantics import Detections, load_detector, no_detections
from jaxslam.semantics.network_check import (
    GOOD_BOX_IOU,
    GOOD_MASK_IOU,
    LABEL,
    check_detector,
    check_in_context,
    check_segmenter,
    drawn_shapes,
)
from jaxslam.semantics.prompted import load_segmenter
from jaxslam.semantics.prompted.detector import boxes_of


def _box(*edges: float, label: str = LABEL) -> Callable[[np.ndarray], Detections]:
    found = Detections(np.array([edges], np.float32), np.ones(1, np.float32), (label,), None, None)
    return lambda image: found


class TestShapes:
    def test_are_the_same_each_time(self) -> None:
        (one, shapes), (other, again) = drawn_shapes(), drawn_shapes()
        np.testing.assert_array_equal(one, other)
        assert all((shapes[name] == again[name]).all() for name in shapes)

    def test_fill_less_than_half_of_their_boxes_and_the_middle(self) -> None:
        picture, shapes = drawn_shapes()
        masks = np.array(list(shapes.values()))
        assert (picture[masks.any(axis=0)].mean(axis=1) > 130).mean() > 0.99
        assert picture[~masks.any(axis=0)].mean() < 80
        assert masks.sum(axis=0).max() == 1
        for mask, (left, top, right, bottom) in zip(masks, boxes_of(masks).astype(int), strict=True):
            assert mask.sum() < 0.5 * (right - left) * (bottom - top)
            assert mask[(top + bottom) // 2, (left + right) // 2]


class TestSegmenters:
    @pytest.mark.parametrize("build", [tiny_segmenters.sam, tiny_segmenters.sam2])
    def test_good(self, tmp_path: Path, build: Callable[[Path], tuple[Path, Path]]) -> None:
        check = check_segmenter(load_segmenter(*build(tmp_path)))
        assert check.good
        assert check.iou == pytest.approx(np.median(check.ious))
        assert check.found.masks is not None
        assert check.found.labels == check.things == ("star", "cross", "bar", "leaf")

    def test_that_paints_boxes_is_bad(self, tmp_path: Path) -> None:
        check = check_segmenter(load_segmenter(*tiny_segmenters.sam(tmp_path, blind=True)))
        assert not check.good
        assert max(check.ious) < 0.5 < GOOD_MASK_IOU

    def test_in_context(self, tmp_path: Path) -> None:
        """A network of a few pixels sees too little of thin shapes."""
        fine = check_in_context(tiny_segmenters.in_context(tmp_path / "fine.onnx", side=112))
        coarse = check_in_context(tiny_segmenters.in_context(tmp_path / "coarse.onnx", side=28))
        assert fine.good
        assert not coarse.good


class TestDetectors:
    def test_good(self) -> None:
        check = check_detector(_box(20, 10, 360, 500))
        assert check.good
        assert check.ious[0] > 0.9

    @pytest.mark.parametrize(
        "detector",
        [
            lambda image: no_detections(),
            _box(20, 10, 360, 500, label="cat"),
            _box(0, 0, 512, 512),
            _box(200, 10, 512, 300),
            lambda image: no_detections()._replace(class_mask=np.ones(image.shape[:2], bool)),
        ],
        ids=["nothing", "another class", "everything", "beside", "mask of everything"],
    )
    def test_bad(self, detector: Callable[[np.ndarray], Detections]) -> None:
        check = check_detector(detector)
        assert not check.good
        assert check.iou < GOOD_BOX_IOU

    @pytest.mark.parametrize(
        "name", ["yolox_nano", "FastestDet", "nanodet_m_320", "yolov8n-seg_int8", "deeplabv3_mobilenetv2_dm05_voc"]
    )
    def test_real_networks_are_good(self, name: str) -> None:
        assert check_detector(load_detector(real_network(name), labels=(LABEL,))).good
