"""Every family of networks: recognized from its graph, and what it finds comes back in pixels of the image."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import tiny_models
from tiny_models import DOG, HEIGHT, WIDTH, Thing

from jaxslam.semantics import Detections, OnnxDetector, load_detector
from jaxslam.semantics.adapters import ADAPTERS
from jaxslam.semantics.onnx_signature import Graph, Port, image_input

Build = Callable[..., Path]
FAMILIES: dict[str, tuple[Build, str, str]] = {
    "yolox": (tiny_models.yolox, "yolox", "corner"),
    "nanodet": (tiny_models.nanodet, "nanodet", "corner"),
    "nanodet_plus": (tiny_models.nanodet_plus, "nanodet_plus", "corner"),
    "fastestdet": (tiny_models.fastestdet, "fastestdet", "stretch"),
    "yolov8": (tiny_models.yolov8, "yolov8", "center"),
    "yolov8_seg": (tiny_models.yolov8_seg, "yolov8_seg", "center"),
    "tensorflow": (tiny_models.tensorflow_ssd, "ssd", "stretch"),
    "tensorflow_lite": (tiny_models.lite_ssd, "ssd", "stretch"),
    "torchvision": (tiny_models.torchvision_ssd, "ssd", "stretch"),
}
IMAGES = {"same": (96, 64), "wide": (192, 64), "tall": (48, 128), "large": (960, 640)}
"""Widths and heights that the input's are simple shares of."""
PERSON = Thing((13.0, 5.0, 45.0, 31.0), score=0.8)
BESIDE = Thing((-4.0, 20.0, 20.0, 44.0), score=0.6)
PET = Thing((60.0, 10.0, 90.0, 50.0), label=DOG, score=0.9)


@pytest.fixture(params=FAMILIES)
def family(request: pytest.FixtureRequest) -> tuple[Build, str, str]:
    return FAMILIES[request.param]


def blank(size: tuple[int, int] = (WIDTH, HEIGHT), value: int = 40) -> np.ndarray:
    return np.full((size[1], size[0], 3), value, np.uint8)


def in_image(box: tuple[float, ...], size: tuple[int, int], fit: str) -> np.ndarray:
    """Where a box of the input is in an image."""
    scale = np.array([WIDTH / size[0], HEIGHT / size[1]])
    if fit != "stretch":
        scale[:] = scale.min()
    margin = (np.array([WIDTH, HEIGHT]) - scale * size) / 2 * (fit == "center")
    return (np.array(box) - np.tile(margin, 2)) / np.tile(scale, 2)


def assert_same(found: Detections, again: Detections) -> None:
    for one, other in zip(found, again, strict=True):
        assert (one is None) == (other is None)
        if one is not None:
            np.testing.assert_array_equal(one, other)


class TestBoxes:
    @pytest.mark.parametrize("size", IMAGES.values(), ids=IMAGES)
    def test_round_trip(self, family: tuple[Build, str, str], tmp_path: Path, size: tuple[int, int]) -> None:
        build, name, fit = family
        detector = load_detector(build(tmp_path / "tiny.onnx", [BESIDE, PET, PERSON]))
        found = detector(blank(size))
        assert (detector.adapter, detector.input_size) == (name, (WIDTH, HEIGHT))
        assert found.labels == ("person", "person")
        expected = [in_image(thing.box, size, fit) for thing in (PERSON, BESIDE)]
        np.testing.assert_allclose(found.boxes, expected, atol=2e-3 * max(size) / 64)
        np.testing.assert_allclose(found.scores, [0.8, 0.6], atol=1e-5)
        assert (found.boxes.dtype, found.scores.dtype, found.class_mask) == (np.float32, np.float32, None)
        assert_same(found, detector(blank(size)))

    def test_labels(self, family: tuple[Build, str, str], tmp_path: Path) -> None:
        path = family[0](tmp_path / "tiny.onnx", [BESIDE, PET, PERSON])
        assert load_detector(path, labels=("person", "dog"))(blank()).labels == ("dog", "person", "person")
        assert load_detector(path, labels=["cat"])(blank()).labels == ()

    def test_least_score(self, family: tuple[Build, str, str], tmp_path: Path) -> None:
        path = family[0](tmp_path / "tiny.onnx", [BESIDE, PERSON])
        assert len(load_detector(path, min_score=0.7)(blank()).boxes) == 1

    def test_overlap(self, family: tuple[Build, str, str], tmp_path: Path) -> None:
        """Boxes of one class with IoU 0.6, and one of another class over them."""
        shifted = Thing((21.0, 5.0, 53.0, 31.0), score=0.7)
        other = Thing((13.0, -3.0, 45.0, 23.0), label=DOG, score=0.5)
        path = family[0](tmp_path / "tiny.onnx", [shifted, PERSON, other])
        one, both = (load_detector(path, labels=("person", "dog"), nms_iou=most)(blank()) for most in (0.59, 0.61))
        assert (one.labels, both.labels) == (("person", "dog"), ("person", "person", "dog"))

    def test_nothing(self, family: tuple[Build, str, str], tmp_path: Path) -> None:
        found = load_detector(family[0](tmp_path / "tiny.onnx", []))(blank((33, 7)))
        assert (found.boxes.shape, found.scores.shape, found.labels) == ((0, 4), (0,), ())
        assert found.masks is None or found.masks.shape == (0, 7, 33)

    def test_named(self, family: tuple[Build, str, str], tmp_path: Path) -> None:
        path = family[0](tmp_path / "tiny.onnx", [PERSON])
        assert_same(load_detector(path, adapter=family[1])(blank()), load_detector(path)(blank()))

    @pytest.mark.parametrize("stride", [8, 16, 32])
    @pytest.mark.parametrize("build", [tiny_models.yolox, tiny_models.nanodet, tiny_models.nanodet_plus])
    def test_strides(self, tmp_path: Path, build: Build, stride: int) -> None:
        box = (37.0, 30.0, 49.0, 38.0) if stride == 8 else (30.0, 8.0, 70.0, 60.0)
        found = load_detector(build(tmp_path / "tiny.onnx", [Thing(box, stride=stride)]))(blank())
        np.testing.assert_allclose(found.boxes, [box], atol=2e-3)

    def test_coarsest_stride(self, tmp_path: Path) -> None:
        thing = Thing((-3.0, -2.0, 90.0, 61.0), stride=64)
        found = load_detector(tiny_models.nanodet_plus(tmp_path / "tiny.onnx", [thing]))(blank())
        np.testing.assert_allclose(found.boxes, [thing.box], atol=2e-3)


class TestMasks:
    def test_end_with_their_box(self, tmp_path: Path) -> None:
        """The prototype is the upper half of the input; the image lies in the middle of it."""
        things = [Thing((20.0, 20.0, 60.0, 50.0), score=0.8), Thing((70.0, 40.0, 90.0, 60.0), score=0.7)]
        path = tiny_models.yolov8_seg(tmp_path / "tiny.onnx", things)
        expected = np.zeros((2, 64, 192), bool)
        expected[0, 8:32, 40:120] = True
        masks = load_detector(path)(blank((192, 64))).masks
        assert masks is not None
        np.testing.assert_array_equal(masks, expected)

    def test_box_beside_the_image(self, tmp_path: Path) -> None:
        path = tiny_models.yolov8_seg(tmp_path / "tiny.onnx", [Thing((20.0, 1.0, 60.0, 9.0))])
        found = load_detector(path)(blank((192, 64)))
        assert found.masks is not None
        assert (len(found.boxes), found.masks.any()) == (1, False)


def save_map(path: Path, values: np.ndarray, *, first: bool, names: str | None = None) -> Path:
    shape, dtype = ((1, 3, HEIGHT, WIDTH), "float32") if first else ((1, HEIGHT, WIDTH, 3), "uint8")
    metadata = {"names": names} if names else None
    return tiny_models.save(path, {"map": values}, shape=shape, dtype=dtype, metadata=metadata)


class TestClassMap:
    def numbers(self, inside: int, dtype: type = np.int64) -> np.ndarray:
        numbers = np.zeros((1, HEIGHT, WIDTH), dtype)
        numbers[0, 16:32, 24:48] = inside
        numbers[0, 40:, 60:] = 8
        return numbers

    @pytest.mark.parametrize("dtype", [np.int64, np.int32, np.uint8])
    @pytest.mark.parametrize("size", IMAGES.values(), ids=IMAGES)
    def test_round_trip(self, tmp_path: Path, size: tuple[int, int], dtype: type) -> None:
        detector = load_detector(save_map(tmp_path / "tiny.onnx", self.numbers(15, dtype), first=False))
        found = detector(blank(size))
        left, top, right, bottom = in_image((24, 16, 48, 32), size, "corner").astype(int)
        expected = np.zeros(size[::-1], bool)
        expected[top:bottom, left:right] = True
        assert detector.adapter == "class_map"
        assert (len(found.boxes), found.labels, found.masks) == (0, (), None)
        assert found.class_mask is not None
        assert found.class_mask.dtype == bool
        wrong = np.count_nonzero(found.class_mask != expected)
        assert wrong <= (0 if size == (WIDTH, HEIGHT) else 0.05 * expected.sum())

    def test_several_labels(self, tmp_path: Path) -> None:
        path = save_map(tmp_path / "tiny.onnx", self.numbers(15), first=False)
        mask = load_detector(path, labels=("person", "cat"))(blank()).class_mask
        np.testing.assert_array_equal(mask, self.numbers(15)[0] > 0)

    def test_ignored_number(self, tmp_path: Path) -> None:
        mask = load_detector(save_map(tmp_path / "tiny.onnx", self.numbers(255), first=False))(blank()).class_mask
        assert mask is not None
        assert not mask.any()

    @pytest.mark.parametrize("first", [True, False])
    def test_scores(self, tmp_path: Path, first: bool) -> None:
        """Half the input's resolution; the best class counts, not its score."""
        scores = np.full((1, 21, HEIGHT // 2, WIDTH // 2), -3, np.float32)
        scores[0, 0] = -1
        scores[0, 15, 8:16, 12:24] = 5
        path = save_map(tmp_path / "tiny.onnx", scores if first else scores.transpose(0, 2, 3, 1), first=first)
        mask = load_detector(path)(blank()).class_mask
        expected = self.numbers(15)[0] == 15
        assert mask is not None
        assert np.count_nonzero(mask & expected) / np.count_nonzero(mask | expected) > 0.85

    def test_names_in_the_metadata(self, tmp_path: Path) -> None:
        names = str([*map(str, range(8)), "aeroplane"])
        path = save_map(tmp_path / "tiny.onnx", self.numbers(1), first=False, names=names)
        mask = load_detector(path, labels=["airplane"])(blank()).class_mask
        np.testing.assert_array_equal(mask, self.numbers(1)[0] == 8)

    def test_every_class_wanted(self, tmp_path: Path) -> None:
        names = "{0: 'person', 1: 'dog'}"
        path = save_map(tmp_path / "t.onnx", np.full((1, 2, HEIGHT, WIDTH), -1, np.float32), first=True, names=names)
        mask = load_detector(path, labels=["person", "dog"])(blank()).class_mask
        assert mask is not None
        assert mask.all()


def adapter(name: str, shape: tuple[int, ...], dtype: str, *outputs: Port):
    inputs = (Port("images", shape, dtype),)
    image = image_input(inputs, 32)
    assert image is not None
    return ADAPTERS[name](Graph(image, inputs, outputs, None), image)


FIRST, LAST = (1, 3, HEIGHT, WIDTH), (1, HEIGHT, WIDTH, 3)
CELLS = tiny_models.num_cells((8, 16, 32))
RED = (200, 100, 50)
SSD = tuple(Port(name, (1, 9, 4)[: 3 - (i > 0)], "float32") for i, name in enumerate(("boxes", "scores", "classes")))


class TestInput:
    """What the networks see of an image of one color."""

    @pytest.mark.parametrize(
        ("name", "shape", "dtype", "outputs", "expected", "pad"),
        [
            ("yolox", FIRST, "float32", [Port("o", (1, CELLS, 85), "float32")], (50, 100, 200), 114),
            (
                "nanodet_plus",
                FIRST,
                "float32",
                [Port("o", (1, CELLS + 2, 112), "float32")],
                ((50 - 103.53) / 57.375, (100 - 116.28) / 57.12, (200 - 123.675) / 58.395),
                (114 - 103.53) / 57.375,
            ),
            (
                "fastestdet",
                FIRST,
                "float32",
                [Port("o", (1, 85, HEIGHT // 16, WIDTH // 16), "float32")],
                (50 / 255, 100 / 255, 200 / 255),
                None,
            ),
            (
                "yolov8",
                FIRST,
                "float32",
                [Port("o", (1, 84, CELLS), "float32")],
                (200 / 255, 100 / 255, 50 / 255),
                None,
            ),
            ("ssd", FIRST, "float32", SSD, (200 / 255, 100 / 255, 50 / 255), None),
            ("ssd", LAST, "float32", SSD, (200 / 127.5 - 1, 100 / 127.5 - 1, 50 / 127.5 - 1), None),
            ("ssd", LAST, "uint8", SSD, RED, None),
            ("class_map", LAST, "uint8", [Port("o", (1, HEIGHT, WIDTH), "int64")], RED, 127),
            (
                "class_map",
                FIRST,
                "float32",
                [Port("o", (1, 21, HEIGHT, WIDTH), "float32")],
                ((200 - 123.675) / 58.395, (100 - 116.28) / 57.12, (50 - 103.53) / 57.375),
                (127 - 123.675) / 58.395,
            ),
        ],
        ids=lambda value: value if isinstance(value, str) else "",
    )
    def test_values(self, name, shape, dtype, outputs, expected, pad) -> None:
        image = np.full((30, 90, 3), RED, np.uint8)
        tensor, placement = adapter(name, shape, dtype, *outputs).prepare(image)
        assert (tensor.shape, tensor.dtype, tensor.flags.c_contiguous) == (shape, np.dtype(dtype), True)
        pixels = tensor[0].transpose(1, 2, 0) if shape == FIRST else tensor[0]
        np.testing.assert_allclose(pixels[HEIGHT // 2 - 2, WIDTH // 2], expected, rtol=1e-5)
        if pad is not None:
            assert placement.offset == (0, 0)
            np.testing.assert_allclose(pixels[33:, :, 0], pad, rtol=1e-5)
            np.testing.assert_allclose(pixels[:32], np.broadcast_to(expected, (32, WIDTH, 3)), rtol=1e-5)

    def test_half_precision(self, tmp_path: Path) -> None:
        output = tiny_models.yolox_output([PERSON]).astype(np.float16)
        found = load_detector(tiny_models.save(tmp_path / "t.onnx", {"output": output}, dtype="float16"))(blank())
        np.testing.assert_allclose(found.boxes, [PERSON.box], atol=0.05)
        assert (found.boxes.dtype, found.scores.dtype) == (np.float32, np.float32)


class TestOpenSizes:
    def test_default(self, tmp_path: Path) -> None:
        """A graph that leaves its sizes open is read at 416x416."""
        output = tiny_models.yolox_output([PERSON], (416, 416))
        path = tiny_models.save(
            tmp_path / "tiny.onnx", {"output": output}, shape=("batch", 3, "h", "w"), open_outputs=True
        )
        detector = load_detector(path)
        assert (detector.adapter, detector.input_size) == ("yolox", (416, 416))
        np.testing.assert_allclose(detector(blank((832, 832))).boxes, [np.array(PERSON.box) * 2], atol=1e-2)

    def test_size_in_the_metadata(self, tmp_path: Path) -> None:
        output = tiny_models.yolox_output([PERSON], (128, 128))
        shape, metadata = (1, 3, "h", "w"), {"imgsz": "[128, 128]"}
        path = tiny_models.save(tmp_path / "tiny.onnx", {"output": output}, shape=shape, metadata=metadata)
        assert load_detector(path).input_size == (128, 128)


def one_thread(detector: OnnxDetector) -> tuple[int, int]:
    options = detector._network._session.get_session_options()
    return options.intra_op_num_threads, options.inter_op_num_threads


def test_threads(tmp_path: Path) -> None:
    path = tiny_models.yolox(tmp_path / "tiny.onnx", [PERSON])
    assert one_thread(load_detector(path)) == (1, 1)
    detector = load_detector(path, num_threads=2)
    assert one_thread(detector) == (2, 1)
    options = detector._network._session.get_session_options()
    assert options.get_session_config_entry("session.intra_op.allow_spinning") == "0"
