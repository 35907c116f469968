"""What a detector of one's own answers is checked, and the error says what is wrong about it."""

from typing import Any

import numpy as np
import pytest
from small_scene import CONFIG, HEIGHT, WIDTH, clip

from jaxslam.errors import ModelError
from jaxslam.semantics import Detections, no_detections
from jaxslam.semantics.checked_detector import CheckedDetector
from jaxslam.semantics.detection_checks import check_answer
from jaxslam.slam.slam import Slam
from jaxslam.tracking.state import TrackStatus

GOOD = Detections(
    np.array([[10, 20, 30, 60], [-5, 0, 200, 90]], np.float32),
    np.array([0.9, 0.0], np.float32),
    ("person", "dog"),
    np.zeros((2, HEIGHT, WIDTH), bool),
    np.zeros((HEIGHT, WIDTH), bool),
)


@pytest.mark.parametrize("answer", [GOOD, no_detections(), GOOD._replace(masks=None, class_mask=None)])
def test_good_answers(answer: Detections) -> None:
    check_answer(answer, HEIGHT, WIDTH)


@pytest.mark.parametrize(
    ("answer", "words"),
    [
        (None, r"expected jaxslam\.semantics\.Detections, got NoneType"),
        ((GOOD.boxes, GOOD.scores), r"expected jaxslam\.semantics\.Detections, got tuple"),
        (GOOD._replace(boxes=[[1, 2, 3, 4]]), r"boxes: expected \(k, 4\) float32, got list"),  # type: ignore[arg-type]
        (GOOD._replace(boxes=GOOD.boxes.T.copy()), r"boxes: expected \(k, 4\) float32, got \(4, 2\) float32"),
        (GOOD._replace(boxes=GOOD.boxes.astype(int)), r"boxes: expected \(k, 4\) float32, got \(2, 4\) int64"),
        (GOOD._replace(boxes=GOOD.boxes[:, [2, 1, 0, 3]]), "boxes: expected left <= right and top <= bottom"),
        (GOOD._replace(boxes=np.full((2, 4), np.nan, np.float32)), "boxes: expected left <= right .* nan"),
        (GOOD._replace(scores=GOOD.scores[:1]), r"scores: expected \(2,\) float32, one a box, got \(1,\) float32"),
        (GOOD._replace(scores=100 * GOOD.scores), "scores: expected 0 to 1, got 90"),
        (GOOD._replace(labels="person"), "labels: expected a tuple of names, got 'person'"),  # type: ignore[arg-type]
        (GOOD._replace(labels=(0, 16)), r"labels: expected a tuple of names, got \(0, 16\)"),  # type: ignore[arg-type]
        (GOOD._replace(labels=("person",)), "labels: expected 2, one a box, got 1"),
        (
            GOOD._replace(masks=np.zeros((2, 9, 9), bool)),
            r"masks: expected \(2, 120, 160\) bool, one a box at the image's size, got \(2, 9, 9\) bool",
        ),
        (GOOD._replace(class_mask=np.zeros((HEIGHT, WIDTH))), r"class_mask: expected \(120, 160\) bool.* float64"),
    ],
)
def test_wrong_answers(answer: Any, words: str) -> None:
    with pytest.raises(ModelError, match=f"detector: {words}") as error:
        check_answer(answer, HEIGHT, WIDTH)
    assert len(str(error.value)) <= 300


def test_detector_of_ones_own_is_asked_once_an_image() -> None:
    calls: list[int] = []

    def looks(image: np.ndarray) -> Detections:
        calls.append(image.size)
        return GOOD

    detector = CheckedDetector(looks)
    for one in clip().frames[:6]:
        assert detector(one.image) is GOOD
    assert len(calls) == 6
    assert detector.color_suspicion == ""


@pytest.mark.slow
def test_wrong_answer_is_told_with_the_frame() -> None:
    """Tracking goes on without it."""
    wrong: Any = lambda image: GOOD._replace(labels=("person",))
    with Slam(clip().camera, CONFIG, detector=wrong) as slam:
        results = [slam.track(frame) for frame in clip().frames[:10]]
    told = [result.detector_error for result in results if result.detector_error]
    assert told[0] == "ModelError: detector: labels: expected 2, one a box, got 1"
    assert results[-1].status is TrackStatus.OK
