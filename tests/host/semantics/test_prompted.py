"""Promptable segmenters: what is asked for comes back at its place in the image, by one embedding of it."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
import tiny_models
import tiny_segmenters
from real_networks import real_network
from tiny_models import Thing
from tiny_segmenters import RADIUS, SIDE, SURE, UNSURE

from jaxslam.datasets import open_dataset
from jaxslam.errors import ConfigError, FrameError, ModelError
from jaxslam.masks.box_to_mask import mask_of_detections
from jaxslam.semantics import Detections, load_detector, no_detections
from jaxslam.semantics.onnx_session import Network
from jaxslam.semantics.prompted import Prompt, PromptedDetector, PromptSegmenter, load_segmenter, prompt

Pair = tuple[Path, Path]
PAIRS: dict[str, tuple[Callable[[Path], Pair], str, str, int]] = {
    "sam": (tiny_segmenters.sam, "sam", "corner", 1),
    "sam_hwc": (lambda folder: tiny_segmenters.sam(folder, hwc=True), "sam", "corner", 1),
    "sam_many": (lambda folder: tiny_segmenters.sam(folder, many=True), "sam", "corner", 16),
    "sam_masks": (lambda folder: tiny_segmenters.sam(folder, output="masks"), "sam", "corner", 1),
    "sam2": (tiny_segmenters.sam2, "sam2", "stretch", 16),
    "sam2_size": (lambda folder: tiny_segmenters.sam2(folder, size=True), "sam2", "stretch", 16),
    "efficient_sam": (tiny_segmenters.efficient_sam, "efficient_sam", "stretch", 16),
    "efficient_sam_one": (
        lambda folder: tiny_segmenters.efficient_sam(folder, one=True),
        "efficient_sam",
        "stretch",
        1,
    ),
    "transformers_sam": (tiny_segmenters.transformers_sam, "transformers_sam", "corner", 16),
}
SIZES = {"square": (128, 128), "landscape": (640, 480), "portrait": (480, 640), "odd": (301, 777), "wide": (1241, 376)}
"""Widths and heights."""


@pytest.fixture(params=PAIRS)
def family(request: pytest.FixtureRequest, tmp_path: Path) -> tuple[PromptSegmenter, str]:
    """One of each, and how images enter it."""
    build, name, fit, at_once = PAIRS[request.param]
    segmenter = load_segmenter(*build(tmp_path))
    assert (segmenter.adapter, segmenter.at_once) == (name, at_once)
    return segmenter, fit


def white(size: tuple[int, int]) -> np.ndarray:
    return np.full((size[1], size[0], 3), 255, np.uint8)


def scales(size: tuple[int, int], fit: str) -> np.ndarray:
    """Pixels of the input for one of the image, along x and y; the image's side may be rounded there."""
    scale = np.array([SIDE / size[0], SIDE / size[1]])
    return scale if fit == "stretch" else np.round(np.array(size) * scale.min()) / size


def pixels(size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """x and y of the middles of pixels, from the image's corner."""
    x, y = np.meshgrid(np.arange(size[0]) + 0.5, np.arange(size[1]) + 0.5)
    return x, y


def box_mask(box: Sequence[float], size: tuple[int, int]) -> np.ndarray:
    x, y = pixels(size)
    return (x > box[0]) & (x < box[2]) & (y > box[1]) & (y < box[3])


def disc_mask(point: tuple[float, float], size: tuple[int, int], fit: str) -> np.ndarray:
    """A disc in the input is an ellipse in an image that was stretched."""
    (x, y), scale = pixels(size), scales(size, fit)
    return ((x - point[0] - 0.5) * scale[0]) ** 2 + ((y - point[1] - 0.5) * scale[1]) ** 2 < RADIUS**2


def differing(mask: np.ndarray, expected: np.ndarray) -> float:
    return np.count_nonzero(mask != expected) / np.count_nonzero(expected)


def assert_is_box(mask: np.ndarray, box: Sequence[float], size: tuple[int, int]) -> None:
    """To the pixel, but for the corners: what is drawn is the distance from the nearest side, between cells a mean."""
    expected = box_mask(box, size)
    for axis in (0, 1):
        np.testing.assert_array_equal(mask.any(axis=axis), expected.any(axis=axis))
    assert differing(mask, expected) < 0.005


def place(size: tuple[int, int], *shares: float) -> list[float]:
    """Shares of width and height, in turn, in pixels."""
    return [share * size[number % 2] for number, share in enumerate(shares)]


class TestGeometry:
    @pytest.mark.parametrize("size", SIZES.values(), ids=SIZES)
    def test_box_and_point(self, family: tuple[PromptSegmenter, str], size: tuple[int, int]) -> None:
        segmenter, fit = family
        box, point = [round(edge) for edge in place(size, 0.1, 0.25, 0.45, 0.8)], place(size, 0.3, 0.4)
        segments = segmenter(white(size), [prompt("a", box=box), prompt("b", on=[(point[0], point[1])])])
        if segmenter.adapter == "transformers_sam":
            middle = (np.array(box[:2]) + box[2:]) / 2 - 0.5
            expected = disc_mask((middle[0], middle[1]), size, fit) & box_mask(box, size)
        else:
            expected = box_mask(box, size)
        # The border of a disc is drawn in cells of up to four pixels of the input; that of a box is straight, and
        # exact but where a side falls between pixels.
        assert segments.masks.shape == (2, size[1], size[0])
        assert differing(segments.masks[0], expected) < 0.015
        assert differing(segments.masks[1], disc_mask((point[0], point[1]), size, fit)) < 0.025
        np.testing.assert_allclose(segments.ious, SURE, atol=1e-6)

    @pytest.mark.parametrize("size", [SIZES["landscape"], SIZES["portrait"]], ids=str)
    def test_box_to_the_pixel(self, tmp_path: Path, size: tuple[int, int]) -> None:
        """Where an edge of the box is one of cells."""
        segmenter = load_segmenter(*tiny_segmenters.sam(tmp_path))
        box = (20, 30, 120, 200)
        mask = segmenter(white(size), [prompt("", box=box)]).masks[0]
        assert_is_box(mask, box, size)

    def test_image_and_prompts_share_their_place(self, family: tuple[PromptSegmenter, str]) -> None:
        """Only what is light is drawn: the embedding and the coordinates are of the same picture."""
        segmenter, _ = family
        size = (640, 480)
        image = np.zeros((480, 640, 3), np.uint8)
        image[120:360, 160:320] = 255  # whole blocks of every encoder
        box = (100, 60, 260, 300)
        points = segmenter.adapter == "transformers_sam"
        mask = segmenter(image, [prompt("", box=box, on=[(210, 200)] if points else [])]).masks[0]
        around = disc_mask((210, 200), size, "corner") if points else True
        expected = box_mask(box, size) & around & (image[..., 0] > 0)
        assert differing(mask, expected) < (0.1 if segmenter.adapter == "sam2" else 0.06)  # its cells are coarser

    def test_point_beside(self, family: tuple[PromptSegmenter, str]) -> None:
        segmenter, fit = family
        size, asked = (640, 480), [prompt("", on=[(150, 150)], beside=[(200, 150)])]
        if segmenter.adapter == "efficient_sam":
            with pytest.raises(ModelError, match="efficient_sam knows no points beside a thing, got one"):
                segmenter(white(size), asked)
            return
        expected = disc_mask((150, 150), size, fit) & ~disc_mask((200, 150), size, fit)
        assert differing(segmenter(white(size), asked).masks[0], expected) < 0.06

    def test_colors(self, tmp_path: Path) -> None:
        """RGB, normalized by ImageNet; what is beside the image is 0."""
        image = np.zeros((64, 128, 3), np.uint8)
        image[:] = (255, 128, 0)
        expected = (np.array([255, 128, 0]) - tiny_segmenters.MEAN) / tiny_segmenters.STD
        for hwc in (False, True):
            values = load_segmenter(*tiny_segmenters.sam(tmp_path, hwc=hwc)).embed(image).values["image_embeddings"]
            np.testing.assert_allclose(values[0, :, 4, 4], expected, atol=1e-5)
            assert (values[0, :, 8:] == 0).all()
        for build in (tiny_segmenters.efficient_sam, tiny_segmenters.transformers_sam):
            values = load_segmenter(*build(tmp_path)).embed(image).values["image_embeddings"]
            np.testing.assert_allclose(values[0, :, 2, 2], expected, atol=1e-5)


class TestRuns:
    """How often the networks run, and with how many prompts."""

    @pytest.fixture
    def runs(self, monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, int]]:
        """The file of each run, and its prompts."""
        seen: list[tuple[str, int]] = []
        feed = Network.feed

        def counted(network: Network, inputs: dict[str, np.ndarray]) -> list[Any]:
            num = inputs["point_coords"].shape[0] if "point_coords" in inputs else 0
            seen.append((network.path.stem, num))
            return feed(network, inputs)

        monkeypatch.setattr(Network, "feed", counted)
        return seen

    def asked(self, num: int) -> list[Prompt]:
        return [prompt(str(n), box=(2 * n, 10, 2 * n + 20, 40)) for n in range(num)]

    @pytest.mark.parametrize(("many", "expected"), [(False, [1] * 20), (True, [16, 4])])
    def test_once_an_image(self, tmp_path: Path, runs: list[tuple[str, int]], many: bool, expected: list[int]) -> None:
        segmenter = load_segmenter(*tiny_segmenters.sam(tmp_path, many=many))
        runs.clear()
        masks = segmenter(white((128, 96)), self.asked(20)).masks
        assert runs == [("sam_encoder", 0), *(("sam_decoder", num) for num in expected)]
        for asked, mask in zip(self.asked(20), masks, strict=True):
            assert asked.box is not None
            assert_is_box(mask, asked.box, (128, 96))

    def test_no_prompt_no_run(self, tmp_path: Path, runs: list[tuple[str, int]]) -> None:
        segmenter = load_segmenter(*tiny_segmenters.sam(tmp_path))
        runs.clear()
        assert segmenter(white((64, 48)), []).masks.shape == (0, 48, 64)
        assert not runs

    def test_embedding_is_kept(self, tmp_path: Path, runs: list[tuple[str, int]]) -> None:
        segmenter = load_segmenter(*tiny_segmenters.sam2(tmp_path))
        embedding = segmenter.embed(white((128, 96)))
        runs.clear()
        first, second = (segmenter.segment(embedding, self.asked(2)[n : n + 1]) for n in (0, 1))
        assert runs == [("sam2_decoder", 1)] * 2
        assert (first.masks != second.masks).any()

    def test_kinds_of_prompts_are_apart(self, tmp_path: Path, runs: list[tuple[str, int]]) -> None:
        """No row that is no point fills up a batch; answers come in the order of the prompts."""
        segmenter = load_segmenter(*tiny_segmenters.sam2(tmp_path))
        runs.clear()
        mixed = [prompt("", on=[(30, 30)]), *self.asked(2), prompt("", on=[(60, 40)])]
        masks = segmenter(white((128, 96)), mixed).masks
        assert sorted(runs) == [("sam2_decoder", 2), ("sam2_decoder", 2), ("sam2_encoder", 0)]
        for place, point in ((0, (30, 30)), (3, (60, 40))):
            assert differing(masks[place], disc_mask(point, (128, 96), "stretch")) < 0.1

    def test_batch_that_is_only_declared(self, tmp_path: Path) -> None:
        """An export may promise any number of prompts, and answer the first alone, or none."""
        encoder, decoder = tiny_segmenters.sam(tmp_path, many=True)
        model = onnx.load(decoder)
        node = next(node for node in model.graph.node if "middle" in node.output)
        node.output[0] = "each"
        model.graph.initializer.append(onnx.numpy_helper.from_array(np.array([1]), "second"))
        cut = onnx.helper.make_node("Slice", ["each", "zero", "second", "zero"], ["middle"])
        model.graph.node.insert(list(model.graph.node).index(node) + 1, cut)
        onnx.save(model, decoder)
        segmenter = load_segmenter(encoder, decoder)
        assert segmenter.at_once == 1
        np.testing.assert_allclose(segmenter(white((128, 96)), self.asked(12)).ious[[0, -1]], [SURE, SURE])

    def test_same_bytes(self, family: tuple[PromptSegmenter, str]) -> None:
        image = np.random.default_rng(0).integers(0, 256, (90, 70, 3), np.uint8)
        first, again = (family[0](image, self.asked(3)) for _ in range(2))
        assert first.masks.tobytes() == again.masks.tobytes()
        assert first.ious.tobytes() == again.ious.tobytes()


class TestRefused:
    def test_missing_file(self, tmp_path: Path) -> None:
        encoder, _ = tiny_segmenters.sam(tmp_path)
        with pytest.raises(ModelError, match=r"none.onnx: expected an ONNX file, got nothing there"):
            load_segmenter(encoder, tmp_path / "none.onnx")

    def test_no_pair(self, tmp_path: Path) -> None:
        (encoder, _), (_, decoder) = tiny_segmenters.sam(tmp_path), tiny_segmenters.sam2(tmp_path)
        with pytest.raises(ModelError, match=r"expected outputs high_res_feats_0, .*image_embed, got image_embeddings"):
            load_segmenter(encoder, decoder)

    def test_wrong_way_round(self, tmp_path: Path) -> None:
        encoder, decoder = tiny_segmenters.sam(tmp_path)
        with pytest.raises(ModelError, match=r"of one of these families: sam: image -> .*; got .*sam_decoder.onnx"):
            load_segmenter(decoder, encoder)

    def test_input_that_is_not_known(self, tmp_path: Path) -> None:
        """As that of SAM-HQ, which wants more of the encoder."""
        encoder, decoder = tiny_segmenters.sam(tmp_path)
        model = onnx.load(decoder)
        more = onnx.helper.make_tensor_value_info("interm_embeddings", onnx.TensorProto.FLOAT, (1,))
        model.graph.input.append(more)
        onnx.save(model, decoder)
        with pytest.raises(ModelError, match=r"of one of these families: .*interm_embeddings float32 1; outputs"):
            load_segmenter(encoder, decoder)

    def test_decoder_that_does_not_run(self, tmp_path: Path) -> None:
        encoder, decoder = tiny_segmenters.sam(tmp_path)
        model = onnx.load(decoder)
        plane = next(each for each in model.graph.initializer if each.name == "plane")
        plane.CopyFrom(onnx.numpy_helper.from_array(np.array([7, 9]), "plane"))
        del model.graph.value_info[:]
        onnx.save(model, decoder)
        with pytest.raises(ModelError, match=r"sam_decoder.onnx: "):
            load_segmenter(encoder, decoder)(white((64, 48)), [prompt("", box=(0, 0, 4, 4))])

    def test_adapter(self, tmp_path: Path) -> None:
        pair = tiny_segmenters.sam(tmp_path)
        with pytest.raises(ModelError, match=r"adapter: expected one of sam, sam2, .* got 'sam3' \(did you mean 'sam"):
            load_segmenter(*pair, adapter="sam3")
        with pytest.raises(ModelError, match="of one of these families: efficient_sam: "):
            load_segmenter(*pair, adapter="efficient_sam")
        assert load_segmenter(*pair, adapter="sam").adapter == "sam"

    def test_threads(self, tmp_path: Path) -> None:
        with pytest.raises(ConfigError, match="num_threads: expected an integer >= 1, got 0"):
            load_segmenter(*tiny_segmenters.sam(tmp_path), num_threads=0)

    @pytest.mark.parametrize("image", [None, white((8, 8))[..., 0], white((8, 8)).astype(np.float32)])
    def test_image(self, tmp_path: Path, image) -> None:
        segmenter = load_segmenter(*tiny_segmenters.sam(tmp_path))
        for prompts in ([], [prompt("", box=(0, 0, 4, 4))]):
            with pytest.raises(FrameError, match=r"image: expected \(height, width, 3\) RGB uint8, got"):
                segmenter(image, prompts)

    def test_too_many_points(self, tmp_path: Path) -> None:
        segmenter = load_segmenter(*tiny_segmenters.efficient_sam(tmp_path, one=True))
        with pytest.raises(
            ModelError, match=r"decoder.onnx: input batched_point_coords: expected at most 2 points a pr"
        ):
            segmenter(white((64, 48)), [prompt("", on=[(1, 1), (2, 2), (3, 3)])])

    def test_not_finite(self, tmp_path: Path) -> None:
        encoder, decoder = tiny_segmenters.sam(tmp_path)
        model = onnx.load(decoder)
        offered = next(each for each in model.graph.initializer if each.name == "offered")
        offered.CopyFrom(onnx.numpy_helper.from_array(np.full((1, 4), np.nan, np.float32), "offered"))
        onnx.save(model, decoder)
        with pytest.raises(ModelError, match=r"sam_decoder.onnx: output iou_predictions: expected finite numbers"):
            load_segmenter(encoder, decoder)(white((64, 48)), [prompt("", box=(0, 0, 4, 4))])

    def test_shapes(self, tmp_path: Path) -> None:
        """Three scores for four masks."""
        encoder, decoder = tiny_segmenters.sam(tmp_path)
        model = onnx.load(decoder)
        offered = next(each for each in model.graph.initializer if each.name == "offered")
        offered.CopyFrom(onnx.numpy_helper.from_array(np.ones((1, 3), np.float32), "offered"))
        del model.graph.output[1].type.tensor_type.shape.dim[:]
        onnx.save(model, decoder)
        expected = (
            r"outputs low_res_masks and iou_predictions: expected masks and scores of 1 prompts, got \(1, 4, 64, 64\)"
        )
        with pytest.raises(ModelError, match=expected):
            load_segmenter(encoder, decoder)(white((64, 48)), [prompt("", box=(0, 0, 4, 4))])


def found(boxes: list[list[float]], masks: np.ndarray | None = None) -> Detections:
    """Detections with scores that fall."""
    scores = np.linspace(0.9, 0.5, len(boxes), dtype=np.float32)
    return Detections(np.array(boxes, np.float32).reshape(-1, 4), scores, ("person",) * len(boxes), masks, None)


class TestDetector:
    SIZE = (256, 192)

    @pytest.fixture
    def segmenter(self, tmp_path: Path) -> PromptSegmenter:
        return load_segmenter(*tiny_segmenters.sam(tmp_path))

    def test_masks_of_boxes(self, segmenter: PromptSegmenter) -> None:
        boxes = [[20.0, 30.0, 80.0, 150.0], [-40.0, 60.0, 20.0, 400.0]]
        result = PromptedDetector(segmenter, lambda image: found(boxes))(white(self.SIZE))
        assert result.masks is not None
        np.testing.assert_array_equal(result.boxes, boxes)
        assert result.labels == ("person", "person")
        assert_is_box(result.masks[0], boxes[0], self.SIZE)
        assert_is_box(result.masks[1], (0, 60, 20, 192), self.SIZE)

    def test_boxes_out_of_sight(self, segmenter: PromptSegmenter) -> None:
        boxes = [[300.0, 30.0, 380.0, 150.0], [10.0, 10.0, 10.5, 90.0], [20.0, 30.0, 80.0, 150.0]]
        result = PromptedDetector(segmenter, lambda image: found(boxes))(white(self.SIZE))
        assert result.masks is not None
        assert result.masks.any(axis=(1, 2)).tolist() == [False, False, True]

    def test_unsure_masks(self, segmenter: PromptSegmenter) -> None:
        """The network is unsure on the right; a box there keeps the detector's mask, or is made one by depth."""
        boxes, own = [[20.0, 30.0, 80.0, 150.0], [160.0, 30.0, 220.0, 150.0]], np.zeros((2, 192, 256), bool)
        own[:, 70:80, 165:175] = True
        for before in (None, own):
            result = PromptedDetector(segmenter, lambda image, before=before: found(boxes, before))(white(self.SIZE))
            assert result.masks is not None
            assert_is_box(result.masks[0], boxes[0], self.SIZE)
            np.testing.assert_array_equal(result.masks[1], own[1] if before is own else np.zeros_like(own[1]))
        depth = np.full((192, 256), 4.0)
        depth[40:140, 170:210] = 1.5
        result = PromptedDetector(segmenter, lambda image: found(boxes))(white(self.SIZE))
        mask = mask_of_detections(result, depth, 250.0, dilate_px=0)
        assert_is_box(mask & (depth != 1.5), boxes[0], self.SIZE)
        assert (mask & (depth == 1.5)).sum() == (depth == 1.5).sum()
        low = PromptedDetector(segmenter, lambda image: found(boxes), min_iou=UNSURE - 0.05)(white(self.SIZE))
        assert low.masks is not None
        assert_is_box(low.masks[1], boxes[1], self.SIZE)

    def test_prompts_of_every_frame(self, segmenter: PromptSegmenter) -> None:
        fixed = [prompt("arm", box=(40, 20, 60, 50)), prompt("unsure", box=(200, 20, 240, 50))]
        result = PromptedDetector(segmenter, prompts=fixed)(white(self.SIZE))
        assert result.masks is not None
        assert result.labels == ("arm",)
        np.testing.assert_allclose(result.scores, [SURE], atol=1e-6)
        np.testing.assert_array_equal(result.boxes, [[40, 20, 60, 50]])
        both = PromptedDetector(segmenter, lambda image: found([[0, 0, 30, 30]] * 2), prompts=fixed)(white(self.SIZE))
        assert both.labels == ("person", "arm", "person")
        np.testing.assert_allclose(both.scores, [0.9, 0.9, 0.5], atol=1e-6)

    def test_class_map_is_passed_on(self, segmenter: PromptSegmenter) -> None:
        mask = box_mask((3, 4, 50, 60), self.SIZE)
        result = PromptedDetector(segmenter, lambda image: no_detections()._replace(class_mask=mask))(white(self.SIZE))
        assert result.class_mask is mask
        assert len(result.boxes) == 0

    def test_refused(self, segmenter: PromptSegmenter) -> None:
        with pytest.raises(ConfigError, match="expected a detector or prompts for every frame, got neither"):
            PromptedDetector(segmenter)
        with pytest.raises(ConfigError, match="min_iou: expected a number from 0 to 1, got 2"):
            PromptedDetector(segmenter, lambda image: no_detections(), min_iou=2)
        with pytest.raises(FrameError, match="image: expected"):
            PromptedDetector(segmenter, lambda image: no_detections())(white(self.SIZE)[..., 0])
        outside = PromptedDetector(segmenter, prompts=[prompt("arm", on=[(300, 20)])])
        with pytest.raises(
            ConfigError, match=r"prompt for arm: expected points in 256x192 pixels, got \(300.5, 20.5\)"
        ):
            outside(white(self.SIZE))

    def test_with_a_network_in_front(self, segmenter: PromptSegmenter, tmp_path: Path) -> None:
        """Boxes of a tiny YOLOX become masks of the image's size."""
        path = tiny_models.yolox(tmp_path / "yolox.onnx", [Thing((13.0, 5.0, 45.0, 31.0), score=0.8)])
        result = PromptedDetector(segmenter, load_detector(path))(white((192, 128)))
        assert result.masks is not None
        assert differing(result.masks[0], box_mask((26, 10, 90, 62), (192, 128))) < 0.02


FRAMES = (400, 600, 800)


@pytest.fixture(scope="module")
def images(data_dir: Path) -> list[np.ndarray]:
    folder = data_dir / "bonn" / "rgbd_bonn_crowd"
    if not folder.is_dir():
        pytest.skip(f"JAXSLAM_DATA holds no {folder.name}")
    recording = open_dataset(folder)
    return [recording[number].image for number in FRAMES]


@pytest.mark.parametrize("name", ["yolox_nano", "nanodet_m_320", "FastestDet", "yolov8n-seg_int8"])
def test_real_detectors_in_front(images: list[np.ndarray], tmp_path: Path, name: str) -> None:
    """Every person that they find has a mask, which fills the box: that is what the tiny decoder draws."""
    detector = load_detector(real_network(name))
    segmenter = load_segmenter(*tiny_segmenters.sam(tmp_path, blind=True))
    prompted = PromptedDetector(segmenter, detector, min_iou=0.3)
    total = 0
    for image in images:
        before, after = detector(image), prompted(image)
        size = (image.shape[1], image.shape[0])
        assert after.masks is not None
        np.testing.assert_array_equal(after.boxes, before.boxes)
        assert (after.labels, after.masks.shape) == (before.labels, (len(before.boxes), size[1], size[0]))
        for box, mask in zip(before.boxes, after.masks, strict=True):
            assert differing(mask, box_mask(np.clip(box, 0, np.tile(size, 2)).tolist(), size)) < 0.1
        total += len(before.boxes)
    assert total >= 6
