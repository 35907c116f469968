"""What a detector refuses, and how boxes are chosen."""

from pathlib import Path

import cv2
import numpy as np
import onnx
import pytest
import tiny_models
from hypothesis import given
from hypothesis import strategies as st
from onnx import TensorProto, helper
from tiny_models import HEIGHT, WIDTH, Thing

from jaxslam.config.schema import SemanticsConfig
from jaxslam.errors import ConfigError, FrameError, JaxSlamError, ModelError
from jaxslam.semantics import load_detector, no_detections
from jaxslam.semantics.adapters import ADAPTERS
from jaxslam.semantics.class_names import COCO, COCO_IDS, GROUPS, VOC, find_classes, moves_by_itself
from jaxslam.semantics.from_config import detector_of
from jaxslam.semantics.letterbox import place, plane_to_image
from jaxslam.semantics.onnx_session import check_outputs
from jaxslam.semantics.onnx_signature import Port
from jaxslam.semantics.postprocess import MAX_KEPT, Candidates, Wanted, best_rows, choose

PERSON = Thing((13.0, 5.0, 45.0, 31.0), score=0.8)
IMAGE = np.full((HEIGHT, WIDTH, 3), 40, np.uint8)
CELLS = tiny_models.num_cells((8, 16, 32))


@pytest.fixture
def yolox(tmp_path: Path) -> Path:
    return tiny_models.yolox(tmp_path / "yolox.onnx", [PERSON])


class TestFile:
    def test_missing(self, tmp_path: Path) -> None:
        with pytest.raises(ModelError, match=r"none.onnx: expected an ONNX file, got nothing there"):
            load_detector(tmp_path / "none.onnx")

    def test_folder(self, tmp_path: Path) -> None:
        with pytest.raises(ModelError, match="expected an ONNX file, got a folder"):
            load_detector(tmp_path)

    @pytest.mark.parametrize("share", [0.0, 0.3, 0.99])
    def test_truncated(self, yolox: Path, share: float) -> None:
        whole = yolox.read_bytes()
        yolox.write_bytes(whole[: int(len(whole) * share)])
        with pytest.raises(ModelError, match=r"yolox.onnx: expected an ONNX file, got \d+ bytes that are none"):
            load_detector(yolox)

    def test_another_kind_of_file(self, tmp_path: Path) -> None:
        path = tmp_path / "picture.onnx"
        path.write_bytes(b"\x89PNG\r\n" + bytes(range(256)))
        with pytest.raises(ModelError, match="got 262 bytes that are none"):
            load_detector(str(path))

    def test_is_one_of_ours(self) -> None:
        assert issubclass(ModelError, JaxSlamError)


class TestFamily:
    def test_none_fits(self, tmp_path: Path) -> None:
        """A classifier."""
        path = tiny_models.save(tmp_path / "tiny.onnx", {"logits": np.zeros((1, 1000), np.float32)})
        with pytest.raises(ModelError) as error:
            load_detector(path)
        for words in ("images float32 1x3x64x96", "logits float32 1x1000", "class names: none", *ADAPTERS):
            assert words in str(error.value)

    @pytest.mark.parametrize(
        "shape", [(1, 3), (2, 3, HEIGHT, WIDTH), (1, 1, HEIGHT, WIDTH), (1, 3, 3, HEIGHT, WIDTH)], ids=str
    )
    def test_takes_no_image(self, tmp_path: Path, shape: tuple[int, ...]) -> None:
        path = tiny_models.save(tmp_path / "tiny.onnx", {"o": np.zeros((1, CELLS, 85), np.float32)}, shape=shape)
        with pytest.raises(ModelError, match=f"got inputs: images float32 {'x'.join(map(str, shape))}; outputs"):
            load_detector(path)

    def test_two_inputs(self, tmp_path: Path) -> None:
        model = onnx.load(tiny_models.yolox(tmp_path / "tiny.onnx", []))
        model.graph.input.append(helper.make_tensor_value_info("size", TensorProto.FLOAT, (2,)))
        onnx.save(model, tmp_path / "tiny.onnx")
        with pytest.raises(ModelError, match="images float32 1x3x64x96; size float32 2; outputs"):
            load_detector(tmp_path / "tiny.onnx")

    @pytest.mark.parametrize(
        "shape",
        [
            (1, CELLS * 3, 85),  # YOLOv5: three boxes a cell
            (1, CELLS, 5 + 3),  # three classes, who knows which
            (1, CELLS, 84),
            (1, 56, CELLS),  # YOLOv8 with a skeleton
            (1, 19, HEIGHT, WIDTH),  # Cityscapes, or the parts of a face
            (1, 85, 5, 6),
            (1, 300, 6),
        ],
        ids=str,
    )
    def test_almost_fits(self, tmp_path: Path, shape: tuple[int, ...]) -> None:
        path = tiny_models.save(tmp_path / "tiny.onnx", {"output": np.zeros(shape, np.float32)})
        with pytest.raises(ModelError, match=f"got inputs: .* output float32 {'x'.join(map(str, shape))}; class names"):
            load_detector(path)

    def test_names_in_the_metadata(self, tmp_path: Path) -> None:
        """They tell what the classes of a network are that was trained on others."""
        output = np.zeros((1, 4 + 2, CELLS), np.float32)
        output[0, :, 7] = 40, 30, 20, 10, 0.1, 0.7
        metadata = {"names": "{0: 'robot', 1: 'person'}"}
        detector = load_detector(tiny_models.save(tmp_path / "tiny.onnx", {"o": output}, metadata=metadata))
        found = detector(IMAGE)
        assert (detector.adapter, found.labels) == ("yolov8", ("person",))
        np.testing.assert_allclose(found.boxes, [[30, 25, 50, 35]])

    @pytest.mark.parametrize("names", ["person", "{1: 'person'}", "{'a': 'person'}", "[]", "[1, 2]", "['a', "])
    def test_metadata_that_holds_no_names(self, tmp_path: Path, names: str) -> None:
        path = tiny_models.yolox(tmp_path / "tiny.onnx", [], metadata={"names": names})
        with pytest.raises(ModelError, match=r"metadata names: expected a list of names, or .* number from 0 on, got"):
            load_detector(path)

    def test_unknown_adapter(self, yolox: Path) -> None:
        with pytest.raises(ModelError, match=r"adapter: expected one of yolox, .*got 'yolo' \(did you mean 'yolox'"):
            load_detector(yolox, adapter="yolo")

    def test_wrong_adapter(self, yolox: Path) -> None:
        with pytest.raises(ModelError, match=r"for the adapter nanodet .*got inputs: .* \(it fits yolox\)"):
            load_detector(yolox, adapter="nanodet")


class TestSettings:
    def test_unknown_label(self, yolox: Path) -> None:
        with pytest.raises(ConfigError, match=r"labels: expected classes .*, got 'persn'.*did you mean 'person'"):
            load_detector(yolox, labels=["person", "persn"])

    @pytest.mark.parametrize("labels", ["person", [], [3], [""]])
    def test_bad_labels(self, yolox: Path, labels) -> None:
        with pytest.raises(ConfigError, match="labels: expected"):
            load_detector(yolox, labels=labels)

    @pytest.mark.parametrize("field", ["min_score", "nms_iou"])
    @pytest.mark.parametrize("value", [-0.1, 1.1, float("nan"), "0.5", True])
    def test_bad_shares(self, yolox: Path, field: str, value) -> None:
        with pytest.raises(ConfigError, match=f"{field}: expected a number from 0 to 1, got"):
            load_detector(yolox, **{field: value})

    @pytest.mark.parametrize("threads", [0, -1, 1.5, True])
    def test_bad_threads(self, yolox: Path, threads) -> None:
        with pytest.raises(ConfigError, match="num_threads: expected an integer >= 1, got"):
            load_detector(yolox, num_threads=threads)

    @pytest.mark.parametrize("image", [None, IMAGE[..., 0], IMAGE.astype(np.float32), IMAGE[:0], IMAGE[..., :2]])
    def test_bad_image(self, yolox: Path, image) -> None:
        with pytest.raises(FrameError, match=r"image: expected \(height, width, 3\) RGB uint8, got"):
            load_detector(yolox)(image)

    def test_image_that_is_a_view(self, yolox: Path) -> None:
        turned = np.ascontiguousarray(IMAGE[:, ::-1])[:, ::-1]
        np.testing.assert_array_equal(load_detector(yolox)(turned).boxes, load_detector(yolox)(IMAGE).boxes)


class TestOutputs:
    """A network that fails on an image, though it did not when it was opened."""

    @pytest.mark.parametrize(
        ("how", "words"),
        [
            ("nan", "yolox.onnx: output output: expected finite numbers, got 10710 of 10710 that are not"),
            ("shape", r"yolox.onnx: output output: expected shape \(1, 126, 85\), got \(1, 7, 85\)"),
            ("run", "yolox.onnx: the network does not run: .*Gather"),
        ],
    )
    def test_refused(self, tmp_path: Path, how: str, words: str) -> None:
        detector = load_detector(tiny_models.spoilt(tmp_path / "yolox.onnx", tiny_models.yolox_output([PERSON]), how))
        black = np.zeros_like(IMAGE)
        np.testing.assert_allclose(detector(black).boxes, [PERSON.box], atol=1e-3)
        with pytest.raises(ModelError, match=words):
            detector(IMAGE)
        np.testing.assert_allclose(detector(black).boxes, [PERSON.box], atol=1e-3)

    @pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
    def test_not_finite(self, value: float) -> None:
        port = Port("o", (2, 2), "float32")
        output = np.array([[0, value], [1, 2]], np.float32)
        with pytest.raises(ModelError, match="output o: expected finite numbers, got 1 of 4 that are not"):
            check_outputs([output], (port,), varying=False)
        check_outputs([np.zeros((0, 2), np.float32)], (port,), varying=True)

    @pytest.mark.parametrize(
        ("column", "value", "words"),
        [
            (4, 7.0, "objectness: expected 0 to 1, got 0 to 7 .exported without activation"),
            (5, -3.0, "classes: expected 0 to 1, got -3 to"),
            (2, 60.0, "sizes: expected logarithms of strides up to 10, got 60 .exported with boxes in pixels"),
        ],
    )
    def test_no_probability(self, tmp_path: Path, column: int, value: float, words: str) -> None:
        output = tiny_models.yolox_output([PERSON])
        output[0, output[0, :, 4].argmax(), column] = value
        detector = load_detector(tiny_models.save(tmp_path / "tiny.onnx", {"output": output}))
        with pytest.raises(ModelError, match=words):
            detector(IMAGE)

    def test_unknown_class_in_a_map(self, tmp_path: Path) -> None:
        path = tiny_models.save(tmp_path / "tiny.onnx", {"map": np.full((1, HEIGHT, WIDTH), 34, np.int64)})
        with pytest.raises(ModelError, match="class map: expected 0 to 20, got 34"):
            load_detector(path)(IMAGE)

    def test_pixels_for_shares(self, tmp_path: Path) -> None:
        names = ("detection_boxes", "detection_scores", "detection_classes")
        values = (np.full((1, 1, 4), 30, np.float32), np.ones((1, 1), np.float32), np.ones((1, 1), np.float32))
        path = tiny_models.save(tmp_path / "tiny.onnx", dict(zip(names, values, strict=True)))
        with pytest.raises(ModelError, match="boxes: expected shares of the input, 0 to 1, got up to 30"):
            load_detector(path)(IMAGE)

    def test_class_beyond_the_names(self, tmp_path: Path) -> None:
        path = tiny_models.torchvision_ssd(tmp_path / "tiny.onnx", [Thing((1, 1, 9, 9), label=500)])
        with pytest.raises(ModelError, match="classes: expected 0 to 90, got 500 to 500"):
            load_detector(path)(IMAGE)


def candidates(boxes: np.ndarray, scores: np.ndarray, classes: np.ndarray) -> Candidates:
    return Candidates(boxes.astype(np.float32), scores.astype(np.float32), classes, np.arange(len(boxes)))


def wanted(iou: float = 0.5, min_score: float = 0.1, num_classes: int = 2) -> Wanted:
    return Wanted(("a", "b", "c")[:num_classes], np.ones(num_classes, bool), min_score, iou)


class TestChoose:
    @given(st.integers(0, 2**32 - 1), st.sampled_from([0.3, 0.5, 0.7]))
    def test_matches_opencv(self, seed: int, iou: float) -> None:
        rng = np.random.default_rng(seed)
        corner = rng.integers(0, 60, (40, 2)).astype(float)
        boxes = np.concatenate([corner, corner + rng.integers(5, 40, (40, 2))], axis=1)
        scores = rng.permutation(np.linspace(0.05, 1, 40)).astype(np.float32)
        kept = choose(candidates(boxes, scores, np.zeros(40, int)), wanted(iou)).rows
        sizes = np.concatenate([boxes[:, :2], boxes[:, 2:] - boxes[:, :2]], axis=1)
        expected = cv2.dnn.NMSBoxes(sizes.tolist(), scores.tolist(), 0.1, iou)
        np.testing.assert_array_equal(kept, np.asarray(expected).ravel())

    def test_classes_are_apart(self) -> None:
        """Also where boxes begin left of the image."""
        boxes = np.array([[-90.0, 0, 10, 20], [-90, 0, 10, 20], [-90, 0, 10, 19], [0, 0, 100, 20]])
        found = choose(candidates(boxes, np.array([0.9, 0.8, 0.7, 0.6]), np.array([0, 1, 1, 0])), wanted())
        np.testing.assert_array_equal(found.rows, [0, 1, 3])

    def test_a_thousand_boxes(self) -> None:
        rng = np.random.default_rng(0)
        corner = rng.uniform(0, 4000, (3000, 2))
        boxes, scores = np.concatenate([corner, corner + 3], axis=1), rng.uniform(0.2, 1, 3000)
        found = choose(candidates(boxes, scores, rng.integers(0, 2, 3000)), wanted())
        assert len(found.boxes) == MAX_KEPT
        np.testing.assert_array_equal(found.rows, np.argsort(-scores.astype(np.float32), kind="stable")[:MAX_KEPT])

    def test_boxes_without_area_are_dropped(self) -> None:
        boxes = np.array([[5.0, 5, 5, 9], [9, 5, 5, 9], [5, 5, 9, 9]])
        np.testing.assert_array_equal(choose(candidates(boxes, np.ones(3), np.zeros(3, int)), wanted()).rows, [2])

    def test_boxes_without_end_are_refused(self) -> None:
        boxes = np.array([[5.0, 5, np.inf, 9], [5, 5, 9, 9]])
        with pytest.raises(ModelError, match="boxes: expected finite edges"):
            choose(candidates(boxes, np.ones(2), np.zeros(2, int)), wanted())

    def test_equal_scores_keep_their_order(self) -> None:
        left = 20.0 * np.arange(60)
        boxes = np.stack([left, left * 0, left + 9, left * 0 + 9], axis=1)
        found = choose(candidates(boxes, np.repeat([0.5, 0.9], 30), np.zeros(60, int)), wanted())
        np.testing.assert_array_equal(found.rows, [*range(30, 60), *range(30)])

    def test_best_class_decides(self) -> None:
        """A row is no person if it is a dog with more certainty."""
        person = Wanted(("person", "dog"), np.array([True, False]), 0.3, 0.5)
        scores = np.array([[0.6, 0.7], [0.7, 0.6], [0.2, 0.9]], np.float32)
        rows, best, classes = best_rows(scores, person)
        boxes = np.array([[0.0, 0, 9, 9]] * len(rows))
        np.testing.assert_array_equal(rows[choose(candidates(boxes, best, classes), person).rows], [1])


class TestPlacement:
    @pytest.mark.parametrize("size", [(1, 500), (500, 1), (1, 1), (3, 2)])
    @pytest.mark.parametrize("fit", ["corner", "center", "stretch"])
    def test_odd_images(self, size: tuple[int, int], fit) -> None:
        canvas, placement = place(np.full((size[1], size[0], 3), 9, np.uint8), (WIDTH, HEIGHT), fit, 114)
        assert canvas.shape == (HEIGHT, WIDTH, 3)
        assert np.any(canvas == 9)
        assert min(placement.scale) > 0

    @pytest.mark.parametrize("fit", ["corner", "center", "stretch"])
    @pytest.mark.parametrize("cell", [1, 4])
    def test_plane_and_back(self, fit, cell: int) -> None:
        """The input's own coordinates, as a plane over it, are those of the image's pixels in it."""
        size = (150, 80)
        _, placement = place(np.zeros((size[1], size[0], 3), np.uint8), (WIDTH, HEIGHT), fit, 0)
        x, y = (np.arange(0, side, cell, dtype=np.float32) + cell / 2 for side in (WIDTH, HEIGHT))
        middle = [np.arange(side) + 0.5 for side in size]
        for axis, plane in enumerate(np.meshgrid(x, y)):
            back = plane_to_image(plane, (WIDTH, HEIGHT), placement)
            expected = middle[axis] * placement.scale[axis] + placement.offset[axis]
            row = back[40] if axis == 0 else back[:, 75]
            inner = slice(6, -6)  # a plane does not go on beyond the middle of its last cells
            np.testing.assert_allclose(row[inner], expected[inner], atol=0.05 * cell)


class TestNames:
    def test_numbers(self) -> None:
        assert (len(COCO), len(COCO_IDS), len(VOC), VOC[15]) == (80, 91, 21, "person")
        known = {0: "person", 16: "dog", 39: "bottle", 56: "chair", 57: "couch", 62: "tv", 73: "book", 79: "toothbrush"}
        assert {number: COCO[number] for number in known} == known
        ids = {1: "person", 13: "stop sign", 18: "dog", 44: "bottle", 62: "chair", 67: "dining table", 90: "toothbrush"}
        assert {number: COCO_IDS[number] for number in ids} == ids
        assert set(VOC) - set(COCO) == {"background"}

    def test_words_of_voc(self, yolox: Path) -> None:
        assert load_detector(yolox, labels=["sofa", "tvmonitor", "person"])(IMAGE).labels == ("person",)

    def test_groups_are_supercategories(self) -> None:
        """COCO numbers its categories by supercategory."""
        for group, first, last in (("people", 1, 1), ("vehicles", 2, 9), ("animals", 16, 25)):
            assert set(GROUPS[group]) == set(COCO_IDS[first : last + 1]) - {""}
        members = [name for group in GROUPS.values() for name in group]
        assert len(set(members)) == len(members)
        assert set(members) <= set(COCO)
        assert not set(GROUPS) & set(COCO)

    def test_what_moves_by_itself(self) -> None:
        assert all(map(moves_by_itself, ("person", "car", "motorbike", "dog", "robot")))
        assert not any(map(moves_by_itself, ("chair", "sofa", "suitcase", "book", "tv")))


class TestClasses:
    def test_a_group_is_its_classes(self, yolox: Path) -> None:
        detector = load_detector(yolox, labels=["people", "vehicles", "person"])
        assert detector.labels == ("person", *GROUPS["vehicles"])
        assert detector.missing_labels == ()
        assert detector(IMAGE).labels == ("person",)

    def test_what_the_network_does_not_know_is_left_out(self) -> None:
        """PASCAL VOC has no truck and no zebra."""
        found = find_classes(["vehicles", "dog", "zebra", "sofa"], VOC)
        assert found.known == ("bicycle", "car", "motorcycle", "airplane", "bus", "train", "boat", "dog", "couch")
        assert found.missing == ("truck", "zebra")

    def test_the_network_knows_none(self, tmp_path: Path) -> None:
        output = np.zeros((1, 4 + 2, CELLS), np.float32)
        path = tiny_models.save(tmp_path / "tiny.onnx", {"o": output}, metadata={"names": "['robot', 'person']"})
        with pytest.raises(ConfigError, match=r"labels: expected classes of .*tiny.onnx .person, robot., got vehicles"):
            load_detector(path, labels=["vehicles"])

    def test_own_names_go_first(self) -> None:
        """A network may have a class with the name of a group, and classes that no public data set has."""
        assert find_classes(["animals", "robot"], ["robot", "animals", "dog"]).known == ("animals", "robot")

    def test_missing_classes_are_told(self, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
        output = np.zeros((1, 4 + 2, CELLS), np.float32)
        path = tiny_models.save(tmp_path / "tiny.onnx", {"o": output}, metadata={"names": "['car', 'person']"})
        detector_of(SemanticsConfig(model=str(path), labels=("people", "car", "truck")))
        assert caplog.messages == ["tiny.onnx does not know these classes: truck. It looks for: person, car"]


def test_no_detections() -> None:
    nothing = no_detections()
    assert (nothing.boxes.shape, nothing.scores.shape, nothing.labels) == ((0, 4), (0,), ())
    assert (nothing.masks, nothing.class_mask) == (None, None)
