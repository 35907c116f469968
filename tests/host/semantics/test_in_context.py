"""Examples as prompts: files of them, what is like them in other images, and settings that put networks together."""

import dataclasses
import logging
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import onnx
import pytest
import tiny_models
import tiny_segmenters
from command_line import failing
from tiny_models import Thing
from tiny_segmenters import SURE

from jaxslam.benchmark.suites.provenance import networks_sha256
from jaxslam.cli.entry_point import main
from jaxslam.config.loading import load_config
from jaxslam.config.schema import Config, SemanticsConfig
from jaxslam.datasets.synthetic import SyntheticConfig, SyntheticDataset
from jaxslam.errors import ConfigError, FrameError, JaxSlamError, MissingModelError, ModelError
from jaxslam.io.download import sha256_of
from jaxslam.semantics import OnnxDetector
from jaxslam.semantics.from_config import SCENE, detector_of
from jaxslam.semantics.onnx_session import Network
from jaxslam.semantics.prompted import (
    InContextDetector,
    PromptedDetector,
    load_in_context,
    load_segmenter,
    read_examples,
    with_masks,
)
from jaxslam.sensors.frame import to_gray
from jaxslam.slam.mask_pipeline import MaskPipeline, MaskSource

fails = failing("models")
missing = failing("models", code=2)
RED, GREEN, GRAY = (220, 30, 30), (30, 200, 40), (90, 90, 90)
SIZES = {"square": (112, 112), "landscape": (640, 480), "portrait": (480, 640), "odd": (301, 777)}


def picture(size: tuple[int, int], *things: tuple[tuple[int, int, int, int], tuple[int, int, int]]) -> np.ndarray:
    """Gray, with boxes of colors."""
    image = np.full((size[1], size[0], 3), GRAY, np.uint8)
    for (left, top, right, bottom), color in things:
        image[top:bottom, left:right] = color
    return image


def save(path: Path, image: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2BGR))


def mask_of(size: tuple[int, int], box: tuple[int, int, int, int], value: int = 255) -> np.ndarray:
    mask = np.zeros((size[1], size[0]), np.uint8)
    mask[box[1] : box[3], box[0] : box[2]] = value
    return mask


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Pictures of a red and a green thing, with masks."""
    box = (28, 14, 84, 98)
    for name, color in (("red", RED), ("green", GREEN)):
        save(tmp_path / f"{name}.png", picture((112, 112), (box, color)))
        save(tmp_path / f"{name}_mask.png", mask_of((112, 112), box))
    save(tmp_path / "empty.png", picture((112, 112)))
    return tmp_path


def write(folder: Path, text: str) -> Path:
    path = folder / "examples.yaml"
    path.write_text(text)
    return path


TWO = """
examples:
  - {label: person, image: red.png, mask: red_mask.png}
  - {label: balloon, image: green.png, mask: green_mask.png}
"""


class TestFile:
    def test_images_with_masks(self, folder: Path) -> None:
        first, second = read_examples(write(folder, TWO))
        assert (first.label, second.label) == ("person", "balloon")
        assert first.image is not None
        assert first.mask is not None
        assert tuple(first.image[50, 50]) == RED
        np.testing.assert_array_equal(first.mask, mask_of((112, 112), (28, 14, 84, 98)) > 0)

    def test_mask_of_ones(self, folder: Path) -> None:
        save(folder / "red_mask.png", mask_of((112, 112), (28, 14, 84, 98), 1))
        mask = read_examples(write(folder, TWO))[0].mask
        assert mask is not None
        assert mask.sum() == 56 * 84

    def test_boxes_and_points(self, folder: Path) -> None:
        text = """
        examples:
          - {label: arm, boxes: [[1, 2, 30, 40], [5, 6, 7, 8.5]]}
          - {label: hand, points: [[10, 20], [11, 21]], not_points: [[0, 0]], boxes: [[1, 2, 30, 40]]}
        """
        arm, hand = read_examples(write(folder, text))
        assert [each.box for each in arm.prompts] == [(1, 2, 30, 40), (5, 6, 7, 8.5)]
        assert hand.prompts[0].kinds == (1, 1, 0, 2, 3)
        np.testing.assert_array_equal(hand.prompts[0].points[:3], [[10.5, 20.5], [11.5, 21.5], [0.5, 0.5]])
        assert arm.image is hand.image is None

    def test_folder(self, folder: Path) -> None:
        for label, name in (("person", "red"), ("balloon", "green")):
            for part in ("", "_mask"):
                (folder / "shown" / label).mkdir(parents=True, exist_ok=True)
                shutil.copy(folder / f"{name}{part}.png", folder / "shown" / label / f"a{part}.png")
        found = read_examples(folder / "shown")
        assert [each.label for each in found] == ["balloon", "person"]
        (folder / "shown" / "person" / "a.png").unlink()
        with pytest.raises(ConfigError, match=r"a_mask.png: expected one image a.png or .jpg beside it, got 0"):
            read_examples(folder / "shown")

    @pytest.mark.parametrize(
        ("text", "words"),
        [
            ("", "examples.yaml: missing 'examples'"),
            ("examples: []", r"examples: expected a list of one or more, got \[\]"),
            ("examples: [3]", r"examples\[0\]: expected `key: value` lines, got 3"),
            ("examples: [{image: red.png, mask: red_mask.png}]", r"examples\[0\]: missing 'label'"),
            ("examples: [{label: a, mark: b}]", r"examples\[0\]: unknown key 'mark' \(did you mean 'mask'"),
            ("examples: [{label: '', points: [[1, 2]]}]", "label: expected the name of a class, got ''"),
            ("examples: [{label: 3, points: [[1, 2]]}]", "label: expected text, got 3"),
            ("examples: [{label: a}]", "expected a mask, boxes or points of the object, got none"),
            ("examples: [{label: a, image: red.png}]", "expected a mask, boxes or points of the object, got none"),
            (
                "examples: [{label: a, not_points: [[1, 2]]}]",
                "expected a mask, boxes or points of the object, got none",
            ),
            ("examples: [{label: a, mask: red_mask.png}]", "mask: expected an image, .* beside it, got no image"),
            (
                "examples: [{label: a, image: red.png, mask: red_mask.png, points: [[1, 2]]}]",
                "mask: expected an image, and neither boxes nor points, beside it, got points",
            ),
            ("examples: [{label: a, points: [1, 2]}]", "points: expected a list, each a list of 2.* got "),
            ("examples: [{label: a, boxes: [[1, 2, 3]]}]", "boxes: expected a list, each a list of 4.* got "),
            (
                "examples: [{label: a, boxes: [[9, 2, 3, 4]]}]",
                r"boxes: expected left, top, right, bottom, .* got \[9.0",
            ),
            (
                "examples: [{label: a, boxes: [[1, 2, 3, 4], [1, 2, 3, 4]], points: [[1, 2]]}]",
                "boxes: expected one at most with points, got 2",
            ),
            (
                "examples: [{label: a, image: red.png, points: [[200, 3]]}]",
                r"expected boxes and points in the 112x112 pixels of red.png, got \[\[200.5, 3.5\]\]",
            ),
            ("examples: [{label: a, image: none.png, mask: red_mask.png}]", "none.png: cannot be read"),
        ],
    )
    def test_refused(self, folder: Path, text: str, words: str) -> None:
        with pytest.raises(JaxSlamError, match=words):
            read_examples(write(folder, text))

    def test_bad_masks(self, folder: Path) -> None:
        save(folder / "red_mask.png", mask_of((112, 90), (28, 14, 84, 80)))
        with pytest.raises(ConfigError, match="mask: expected the image's 112x112 pixels, got 112x90"):
            read_examples(write(folder, TWO))
        save(folder / "red_mask.png", np.zeros((112, 112), np.uint8))
        with pytest.raises(ConfigError, match="mask: expected white on the thing, got a black picture"):
            read_examples(write(folder, TWO))

    def test_missing(self, tmp_path: Path) -> None:
        with pytest.raises(ConfigError, match=r"none.yaml: cannot be read"):
            read_examples(tmp_path / "none.yaml")
        with pytest.raises(
            ConfigError, match=r"expected images LABEL/NAME.png with masks LABEL/NAME_mask.png, got none"
        ):
            read_examples(tmp_path)


class TestInContext:
    @pytest.mark.parametrize("size", SIZES.values(), ids=SIZES)
    def test_finds_the_like(self, folder: Path, size: tuple[int, int]) -> None:
        """At its place in images of any shape; two of a kind are two, and what is like nothing is left alone."""
        width, height = size
        left = (width // 8, height // 4, 3 * width // 8, 3 * height // 4)
        right = (5 * width // 8, height // 4, 7 * width // 8, height // 2)
        lower = (5 * width // 8, 3 * height // 4, 7 * width // 8, 7 * height // 8)
        detector = load_in_context(tiny_segmenters.in_context(folder / "net.onnx"), read_examples(write(folder, TWO)))
        found = detector(picture(size, (left, RED), (right, RED), (lower, GREEN)))
        assert sorted(found.labels) == ["balloon", "person", "person"]
        assert found.masks is not None
        expected = {"balloon": [lower], "person": [left, right]}
        for label, boxes in expected.items():
            masks = found.masks[[name == label for name in found.labels]]
            for box in boxes:
                truth = mask_of(size, box) > 0
                overlaps = [np.count_nonzero(mask & truth) / np.count_nonzero(mask | truth) for mask in masks]
                assert max(overlaps) > 0.85
        assert (np.diff(found.scores) <= 0).all()
        assert found.scores.min() > 0.5
        assert (found.boxes.dtype, found.class_mask) == (np.float32, None)

    def test_to_the_pixel(self, folder: Path) -> None:
        """Where the sides of the thing are sides of the network's pixels."""
        detector = load_in_context(tiny_segmenters.in_context(folder / "net.onnx"), read_examples(write(folder, TWO)))
        found = detector(picture((112, 112), ((20, 30, 60, 90), RED)))
        assert found.masks is not None
        np.testing.assert_array_equal(found.boxes, [[20, 30, 60, 90]])
        assert found.masks[0].sum() >= 40 * 60 - 4  # corners are round

    def test_nothing_like_it(self, folder: Path) -> None:
        detector = load_in_context(tiny_segmenters.in_context(folder / "net.onnx"), read_examples(write(folder, TWO)))
        found = detector(picture((60, 40)))
        assert found.masks is not None
        assert (found.boxes.shape, found.masks.shape, found.labels) == ((0, 4), (0, 40, 60), ())

    @pytest.mark.parametrize("many", [True, False])
    def test_examples_of_one_class(self, folder: Path, many: bool, monkeypatch: pytest.MonkeyPatch) -> None:
        """Given at once where the network takes that; what it paints for each is averaged."""
        batches: list[int] = []
        feed = Network.feed

        def counted(network: Network, inputs: dict[str, np.ndarray]) -> list[Any]:
            batches.append(len(inputs["pixel_values"]))
            return feed(network, inputs)

        monkeypatch.setattr(Network, "feed", counted)
        path = tiny_segmenters.in_context(folder / "net.onnx", many=many)
        text = TWO.replace("balloon", "person") + "  - {label: person, image: red.png, mask: red_mask.png}\n"
        found = load_in_context(path, read_examples(write(folder, text)))(picture((112, 112), ((20, 30, 60, 90), RED)))
        assert batches == ([3] if many else [1, 1, 1])
        np.testing.assert_allclose(found.scores, [2 / 3], atol=0.02)
        with_high = load_in_context(path, read_examples(write(folder, text)), min_score=0.7)
        assert not with_high(picture((112, 112), ((20, 30, 60, 90), RED))).labels

    def test_open_size(self, folder: Path) -> None:
        """SegGPT's own, where the graph says none."""
        path = tiny_segmenters.in_context(folder / "net.onnx", side=None)
        found = load_in_context(path, read_examples(write(folder, TWO)))(picture((448, 448), ((21, 30, 60, 90), RED)))
        np.testing.assert_array_equal(found.boxes, [[21, 30, 60, 90]])

    def test_refused(self, folder: Path, tmp_path: Path) -> None:
        path, shown = tiny_segmenters.in_context(folder / "net.onnx"), read_examples(write(folder, TWO))
        with pytest.raises(ConfigError, match="examples: expected one or more with an image and a mask, got none"):
            load_in_context(path, [])
        with pytest.raises(
            ConfigError, match=r"examples.yaml: examples\[0\]: expected an image and a mask of it, got non"
        ):
            load_in_context(path, [shown[0]._replace(mask=None)])
        with pytest.raises(ConfigError, match="min_score: expected a number from 0 to 1, got -1"):
            load_in_context(path, shown, min_score=-1)
        with pytest.raises(ConfigError, match="num_threads: expected an integer >= 1, got 0"):
            load_in_context(path, shown, num_threads=0)
        yolox = tiny_models.yolox(tmp_path / "yolox.onnx", [])
        with pytest.raises(
            ModelError, match=r"yolox.onnx: expected an in-context segmenter, with the inputs pixel_values"
        ):
            load_in_context(yolox, shown)
        with pytest.raises(FrameError, match="image: expected"):
            load_in_context(path, shown)(np.zeros((4, 4), np.uint8))

    def test_bad_outputs(self, folder: Path) -> None:
        path, shown = tiny_segmenters.in_context(folder / "net.onnx"), read_examples(write(folder, TWO))
        model = onnx.load(path)
        next(node for node in model.graph.node if node.op_type == "Concat").attribute[0].i = 3
        del model.graph.output[0].type.tensor_type.shape.dim[:]
        onnx.save(model, path)
        with pytest.raises(ModelError, match=r"pred_masks: expected shape \(1, 3, 112, 56\), got \(1, 3, 56, 112\)"):
            load_in_context(path, shown)(picture((60, 40)))
        path = tiny_segmenters.in_context(folder / "net.onnx")
        black = [each._replace(mask=np.zeros((112, 112), bool)) for each in shown]  # a mean of nothing
        model = onnx.load(path)
        next(node for node in model.graph.node if node.op_type == "Concat").input[1] = "apart"
        onnx.save(model, path)
        with pytest.raises(ModelError, match=r"net.onnx: output pred_masks: expected finite numbers"):
            load_in_context(path, black)(picture((60, 40)))


class TestMasksOfExamples:
    """As USD-SLAM makes the prompts of SegGPT: SAM segments what is shown by boxes and points."""

    def test_made_by_a_promptable_segmenter(self, folder: Path) -> None:
        segmenter = load_segmenter(*tiny_segmenters.sam(folder, blind=True))
        text = "examples: [{label: person, image: red.png, boxes: [[28, 14, 84, 98]]}]"
        mask = with_masks(read_examples(write(folder, text)), segmenter)[0].mask
        assert mask is not None
        assert np.count_nonzero(mask != (mask_of((112, 112), (28, 14, 84, 98)) > 0)) <= 12

    def test_refused(self, folder: Path) -> None:
        shown = read_examples(write(folder, "examples: [{label: a, image: empty.png, boxes: [[8, 8, 40, 40]]}]"))
        with pytest.raises(
            ConfigError, match=r"examples\[0\]: expected a mask, or a promptable segmenter to make it, got"
        ):
            with_masks(shown, None)
        with pytest.raises(ConfigError, match="expected boxes or points of a thing, got some where nothing is found"):
            with_masks(shown, load_segmenter(*tiny_segmenters.sam(folder)))  # which sees nothing in the dark


class TestSettings:
    @pytest.fixture
    def pair(self, tmp_path: Path) -> dict[str, Any]:
        encoder, decoder = tiny_segmenters.sam(tmp_path, blind=True)
        return {"prompt_encoder": str(encoder), "prompt_decoder": str(decoder)}

    @pytest.fixture
    def yolox(self, tmp_path: Path) -> str:
        return str(tiny_models.yolox(tmp_path / "yolox.onnx", [Thing((13.0, 5.0, 45.0, 31.0), score=0.8)]))

    def test_boxes_are_prompts(self, pair: dict[str, Any], yolox: str) -> None:
        detector = detector_of(SemanticsConfig(model=yolox, **pair))
        assert isinstance(detector, PromptedDetector)
        found = detector(picture((192, 128)))
        assert found.masks is not None
        assert found.masks[0].mean() == pytest.approx(64 * 52 / (192 * 128), rel=0.01)
        detector = detector_of(SemanticsConfig(model=yolox, prompt_min_iou=SURE + 0.05, **pair))
        assert detector is not None
        unsure = detector(picture((192, 128)))
        assert unsure.masks is not None
        assert not unsure.masks.any()
        assert len(unsure.boxes) == 1

    def test_prompts_of_every_frame(self, pair: dict[str, Any], folder: Path) -> None:
        examples = str(write(folder, "examples: [{label: arm, boxes: [[10, 20, 60, 90]]}]"))
        detector = detector_of(SemanticsConfig(model=None, examples=examples, **pair))
        assert detector is not None
        assert detector(picture((192, 128))).labels == ("arm",)

    def test_in_context(self, pair: dict[str, Any], folder: Path) -> None:
        network = str(tiny_segmenters.in_context(folder / "net.onnx"))
        detector = detector_of(SemanticsConfig(model=network, examples=str(write(folder, TWO))))
        assert isinstance(detector, InContextDetector)
        by_boxes = str(write(folder, "examples: [{label: person, image: red.png, boxes: [[28, 14, 84, 98]]}]"))
        detector = detector_of(SemanticsConfig(model=network, examples=by_boxes, **pair))
        assert isinstance(detector, InContextDetector)
        assert detector(picture((112, 112), ((20, 30, 60, 90), RED))).labels == ("person",)

    def test_plain(self, yolox: str) -> None:
        assert isinstance(detector_of(SemanticsConfig(model=yolox)), OnnxDetector)

    def test_refused(self, pair: dict[str, Any], folder: Path, yolox: str) -> None:
        fixed = str(write(folder, "examples: [{label: arm, boxes: [[10, 20, 60, 90]]}]"))
        both = folder / "both.yaml"
        both.write_text(TWO + "  - {label: arm, boxes: [[10, 20, 60, 90]]}\n")
        shown = folder / "shown.yaml"
        shown.write_text(TWO)
        class_map = str(tiny_models.save(folder / "map.onnx", {"map": np.zeros((1, 64, 96), np.int64)}))
        one = {"prompt_encoder": pair["prompt_encoder"]}
        cases: list[tuple[dict[str, Any], str]] = [
            (
                {"model": yolox, **one},
                "semantics.prompt_decoder: expected what belongs to semantics.prompt_encoder, got",
            ),
            (
                {"model": yolox, "prompt_decoder": "x"},
                "semantics.prompt_encoder: expected what belongs to semantics.promp",
            ),
            ({"model": None, **pair}, "semantics.prompt_encoder: expected semantics.model, .* got neither"),
            (
                {"model": class_map, **pair},
                "semantics.model: expected boxes for semantics.prompt_encoder, got the map of",
            ),
            ({"model": yolox, "examples": fixed}, "semantics.examples: expected images .* got boxes and points alone"),
            (
                {"model": yolox, "examples": str(both), **pair},
                "expected all examples with an image, or all without, got",
            ),
            ({"model": None, "examples": str(shown)}, "semantics.model: expected an in-context segmenter .*, got null"),
            ({"model": "scene", **pair}, "semantics.model: expected a network, got 'scene'"),
        ]
        for settings, words in cases:
            with pytest.raises(ConfigError, match=words):
                detector_of(SemanticsConfig(**settings))
        with pytest.raises(ModelError, match="expected an in-context segmenter"):
            detector_of(SemanticsConfig(model=yolox, examples=str(shown)))
        with pytest.raises(
            ModelError, match="expected a model file or the name of a known model, got 'mobilesam-encode'"
        ):
            detector_of(SemanticsConfig(model=yolox, prompt_encoder="mobilesam-encode", prompt_decoder="x"))
        with pytest.raises(ConfigError, match="unknown key"):
            load_config(overrides=["semantics.prompt_encode=x"])

    @pytest.mark.usefixtures("models_cache")
    def test_known_but_not_here(self, yolox: str, caplog: pytest.LogCaptureFixture) -> None:
        """Refused; where that is allowed it is said, and masks are made by depth, as without."""
        named = SemanticsConfig(model=yolox, prompt_encoder="mobilesam-encoder", prompt_decoder="mobilesam-decoder")
        with pytest.raises(MissingModelError, match=r"semantics.prompt_encoder: .*--allow-missing-model"):
            detector_of(named)
        settings = dataclasses.replace(named, missing_model="allow")
        with caplog.at_level(logging.WARNING):
            assert isinstance(detector_of(settings), OnnxDetector)
        assert "masks are made by depth: mobilesam-encoder is not on this machine" in caplog.text
        assert networks_sha256(settings) == {
            "model": sha256_of(yolox),
            "prompt_encoder": None,
            "prompt_decoder": None,
        }

    def test_hashes_of_all(self, pair: dict[str, Any], yolox: str) -> None:
        """For results: of the network that finds things and of those that are prompted, whatever is asked for."""
        hashes = {setting: sha256_of(path) for setting, path in pair.items()}
        assert len(hashes) == len(set(hashes.values())) == 2
        assert networks_sha256(SemanticsConfig(model=None, **pair)) == hashes
        assert networks_sha256(SemanticsConfig(model=yolox, **pair)) == {"model": sha256_of(yolox), **hashes}
        assert networks_sha256(SemanticsConfig(model=SCENE)) == {}
        pair["prompt_decoder"] = "nowhere.onnx"
        with pytest.raises(ModelError, match="nowhere"):
            networks_sha256(SemanticsConfig(model=yolox, **pair))

    @pytest.mark.slow
    def test_mask_of_a_frame(self, pair: dict[str, Any], yolox: str) -> None:
        """What the tracker leaves out is the box of the network in front, by the mask that is prompted for."""
        room = SyntheticDataset(SyntheticConfig(frames=1, width=192, height=128, people=0))
        frame, detector = room[0], detector_of(SemanticsConfig(model=yolox, **pair))
        assert frame.depth_m is not None
        made = MaskPipeline(room.camera, detector, Config(semantics=SemanticsConfig(latency_frames=0, dilate_px=0)))
        try:
            mask = made.mask_frame(0, frame.image, to_gray(frame.image), frame.depth_m)
        finally:
            made.close()
        assert (mask.error, mask.source) == ("", MaskSource.DETECTOR)
        expected = np.zeros((128, 192), bool)
        expected[10:62, 26:90] = True
        assert np.count_nonzero(mask.mask != expected) < 0.02 * expected.sum()


class TestCommand:
    @pytest.fixture
    def check(self, folder: Path, capsys: pytest.CaptureFixture[str]) -> Callable[..., str]:
        """What `jaxslam models check` prints of a picture with a red thing."""
        save(folder / "scene.png", picture((192, 128), ((26, 10, 90, 62), RED)))

        def run(*arguments: object) -> str:
            main(["models", "check", *map(str, arguments), "--out", str(folder / "out.png")])
            return capsys.readouterr().out

        return run

    def test_pair(self, folder: Path, check: Callable[..., str]) -> None:
        yolox = tiny_models.yolox(folder / "yolox.onnx", [Thing((13.0, 5.0, 45.0, 31.0), score=0.8)])
        encoder, decoder = tiny_segmenters.sam(folder, blind=True)
        pair = ("--prompt-encoder", encoder, "--prompt-decoder", decoder)
        printed = check(yolox, folder / "scene.png", *pair)
        assert all(word in printed for word in ("person", "0.80", "13.5%", "ms an image", str(encoder), str(decoder)))
        before, after = (cv2.imread(str(folder / name)) for name in ("scene.png", "out.png"))
        assert before is not None
        assert after is not None
        assert (before != after).any(axis=2)[40:60, 30:85].all()
        examples = write(
            folder, "examples: [{label: arm, boxes: [[100, 20, 110, 90]]}, {label: arm, points: [[20, 9]]}]"
        )
        printed = check("none", folder / "scene.png", *pair, "--examples", examples)
        assert "arm" in printed
        assert "person" not in printed

    def test_in_context(self, folder: Path, check: Callable[..., str]) -> None:
        network = tiny_segmenters.in_context(folder / "net.onnx")
        printed = check(network, folder / "scene.png", "--examples", write(folder, TWO))
        assert "person" in printed
        assert "balloon" not in printed

    @pytest.mark.usefixtures("models_cache")
    def test_refused(self, folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
        save(folder / "scene.png", picture((192, 128)))
        yolox = tiny_models.yolox(folder / "yolox.onnx", [])
        check = ("check", str(yolox), str(folder / "scene.png"), "--out", str(folder / "out.png"))
        known = ("--prompt-encoder", "mobilesam-encoder", "--prompt-decoder", "mobilesam-decoder")
        assert "models get mobilesam-encoder" in missing(capsys, *check, *known)
        assert "--adapter: expected none with prompts" in fails(capsys, *check, *known, "--adapter", "yolox")
        pair = tiny_segmenters.sam(folder)
        alone = ("--prompt-encoder", str(pair[0]))
        assert "semantics.prompt_decoder: expected what belongs to" in fails(capsys, *check, *alone)
