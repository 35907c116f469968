"""`jaxslam models`: the table, a download from this machine, and a picture of what a detector finds."""

import hashlib
import json
import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import tiny_models
import tiny_segmenters
from command_line import failing

from jaxslam.cli import fetch, models_check
from jaxslam.cli.entry_point import main
from jaxslam.errors import DownloadError
from jaxslam.semantics import Detections, model_zoo, no_detections
from jaxslam.semantics.adapters import ADAPTERS
from jaxslam.semantics.model_zoo import known_model, known_models
from jaxslam.semantics.prompted import PROMPT_ADAPTERS
from jaxslam.visualization.draw_detections import draw_detections

fails = failing("models")

MODELS = os.environ.get("JAXSLAM_MODELS")
HEIGHT, WIDTH = 120, 160
CONTENT = b"a network"
HASH = hashlib.sha256(CONTENT).hexdigest()


def two_people() -> Detections:
    """One box inside the image, one past all its borders; each with a mask."""
    boxes = np.array([[40, 50, 80, 110], [-20, -10, 400, 300]], np.float32)
    masks = np.zeros((2, HEIGHT, WIDTH), bool)
    masks[0, 60:100, 45:75] = True
    return Detections(boxes, np.array([0.9, 0.4], np.float32), ("person", "dog"), masks, None)


pytestmark = pytest.mark.usefixtures("models_cache")


@pytest.fixture
def image(tmp_path: Path) -> Path:
    path = tmp_path / "gray.png"
    cv2.imwrite(str(path), np.full((HEIGHT, WIDTH, 3), 100, np.uint8))
    return path


class TestHelp:
    @pytest.mark.parametrize(
        ("arguments", "words"), [(["--help"], ["models"]), (["models", "--help"], ["list", "get", "check"])]
    )
    def test_names_the_commands(
        self, capsys: pytest.CaptureFixture[str], arguments: list[str], words: list[str]
    ) -> None:
        with pytest.raises(SystemExit) as stop:
            main(arguments)
        assert stop.value.code == 0
        out = capsys.readouterr().out
        assert all(word in out for word in words)


class TestTable:
    def test_adapters_exist(self) -> None:
        assert {model.adapter for model in known_models().values()} <= {*ADAPTERS, *PROMPT_ADAPTERS, "in_context"}

    def test_lists_them_all(self, capsys: pytest.CaptureFixture[str], models_cache: Path) -> None:
        (models_cache / "FastestDet.onnx").write_bytes(CONTENT)
        main(["models", "list"])
        out = capsys.readouterr().out
        assert all(name in out for name in known_models())
        assert "(default)" in out
        assert f"fastestdet: {models_cache / 'FastestDet.onnx'}" in out
        assert "SHA-256" not in out

    def test_details(self, capsys: pytest.CaptureFixture[str]) -> None:
        main(["models", "list", "--details"])
        out = capsys.readouterr().out
        for model in known_models().values():
            assert (model.url or model.how) in out
            assert model.page in out
            assert (model.sha256 or "") in out


class TestGet:
    @pytest.fixture
    def served(self, monkeypatch: pytest.MonkeyPatch) -> list[dict[str, Any]]:
        """Downloads of `CONTENT` without a network: what was asked for."""
        asked: list[dict[str, Any]] = []

        def give(url: str, path: Path, *, progress: Callable[[int, int | None], None], **expected: Any) -> None:
            asked.append({"url": url, **expected})
            progress(len(CONTENT), len(CONTENT))
            path.write_bytes(CONTENT)

        monkeypatch.setattr(fetch, "download", give)
        return asked

    def test_into_the_cache(
        self, capsys: pytest.CaptureFixture[str], models_cache: Path, served: list[dict[str, Any]]
    ) -> None:
        main(["models", "get", "yolox-nano"])
        model = known_model("yolox-nano")
        assert served == [{"url": model.url, "sha256": model.sha256, "size": model.size_bytes}]
        assert (models_cache / "yolox_nano.onnx").read_bytes() == CONTENT
        out = capsys.readouterr().out
        assert str(models_cache / "yolox_nano.onnx") in out
        assert "Apache-2.0" in out
        assert f"SHA-256 {HASH}, as expected" in out

    @pytest.mark.usefixtures("served")
    def test_without_a_known_hash_prints_the_one_it_has(
        self, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setitem(known_models(), "yolox-nano", replace(known_model("yolox-nano"), sha256=None))
        main(["models", "get", "yolox-nano"])
        assert f"SHA-256 {HASH}, which nobody has checked" in capsys.readouterr().out

    def test_only_once(
        self, capsys: pytest.CaptureFixture[str], models_cache: Path, served: list[dict[str, Any]]
    ) -> None:
        (models_cache / "yolox_nano.onnx").write_bytes(b"mine")
        main(["models", "get", "yolox-nano"])
        assert not served
        out = capsys.readouterr().out
        assert str(models_cache / "yolox_nano.onnx") in out
        assert "another file than the published one" in out
        main(["models", "get", "yolox-nano", "--force"])
        assert len(served) == 1
        assert (models_cache / "yolox_nano.onnx").read_bytes() == CONTENT

    @pytest.mark.usefixtures("served")
    def test_says_if_another_file_goes_first(
        self, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
    ) -> None:
        monkeypatch.setenv("JAXSLAM_MODELS", str(tmp_path))
        (tmp_path / "yolox_nano.onnx").write_bytes(b"mine")
        main(["models", "get", "yolox-nano", "--force"])
        assert f"JAXSLAM_MODELS says: {tmp_path / 'yolox_nano.onnx'}" in capsys.readouterr().out

    @pytest.mark.parametrize("name", [model.name for model in known_models().values() if model.url is None])
    def test_what_must_be_made(
        self, capsys: pytest.CaptureFixture[str], models_cache: Path, served: list[dict[str, Any]], name: str
    ) -> None:
        message = fails(capsys, "get", name)
        assert known_models()[name].how in message
        assert str(models_cache / known_models()[name].file) in message
        assert not served

    def test_misspelt(self, capsys: pytest.CaptureFixture[str]) -> None:
        assert "did you mean 'yolox-tiny'?" in fails(capsys, "get", "yolox-tin")

    def test_no_network(self, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
        def refuse(*_: Any, **__: Any) -> None:
            raise DownloadError("no connection")

        monkeypatch.setattr(fetch, "download", refuse)
        assert fails(capsys, "get", "yolox-nano") == "no connection"


class TestCheck:
    @pytest.fixture
    def found(self, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> dict[str, Any]:
        """A detector that is given `settings`, and finds what stands under `gives`."""
        (tmp_path / "net.onnx").write_bytes(CONTENT)
        known: dict[str, Any] = {"gives": two_people(), "images": []}

        def load(path: Path, **settings: Any) -> Callable[[np.ndarray], Detections]:
            known["path"], known["settings"] = path, settings
            return lambda image: known["images"].append(image) or known["gives"]

        monkeypatch.setattr(models_check, "load_detector", load)
        return known

    def run(self, tmp_path: Path, image: Path, *more: str) -> np.ndarray:
        """The picture that is drawn."""
        out = tmp_path / "out.png"
        main(["models", "check", str(tmp_path / "net.onnx"), str(image), "--out", str(out), *more])
        picture = cv2.imread(str(out))
        assert picture is not None
        return picture

    def test_prints_and_draws(
        self, capsys: pytest.CaptureFixture[str], tmp_path: Path, image: Path, found: dict[str, Any]
    ) -> None:
        picture = self.run(tmp_path, image)
        out = capsys.readouterr().out
        assert all(word in out for word in ("person", "0.90", "dog", "0.40", "6.2%", " ms an image"))
        assert picture.shape == (HEIGHT, WIDTH, 3)
        assert (picture[80, 60] != 100).any()
        assert found["images"][0].shape == (HEIGHT, WIDTH, 3)
        assert found["settings"] == {"labels": ("person",), "min_score": 0.3, "adapter": None}

    def test_json(self, capsys: pytest.CaptureFixture[str], tmp_path: Path, image: Path, found: dict[str, Any]) -> None:
        self.run(tmp_path, image, "--json")
        told = json.loads(capsys.readouterr().out)
        assert [(row["label"], row["score"]) for row in told["found"]] == [
            ("person", pytest.approx(0.9)),
            ("dog", pytest.approx(0.4)),
        ]
        assert len(told["found"][0]["box"]) == 4
        assert told["median_ms"] > 0
        assert len(found["images"]) > 1

    def test_settings(self, tmp_path: Path, image: Path, found: dict[str, Any]) -> None:
        self.run(tmp_path, image, "--labels", "person, dog", "--adapter", "yolox", "--min-score", "0.5")
        assert found["settings"] == {"labels": ("person", "dog"), "min_score": 0.5, "adapter": "yolox"}
        assert found["path"] == tmp_path / "net.onnx"

    def test_network_sees_rgb(self, tmp_path: Path, image: Path, found: dict[str, Any]) -> None:
        red_bgr = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
        red_bgr[..., 2] = 255
        cv2.imwrite(str(image), red_bgr)
        found["gives"] = no_detections()
        assert (self.run(tmp_path, image) == red_bgr).all()
        assert (found["images"][0][0, 0] == (255, 0, 0)).all()

    def test_nothing_found(
        self, capsys: pytest.CaptureFixture[str], tmp_path: Path, image: Path, found: dict[str, Any]
    ) -> None:
        found["gives"] = no_detections()
        assert (self.run(tmp_path, image) == 100).all()
        assert "Found nothing: no person with a score of at least 0.3." in capsys.readouterr().out

    def test_class_map(
        self, capsys: pytest.CaptureFixture[str], tmp_path: Path, image: Path, found: dict[str, Any]
    ) -> None:
        mask = np.zeros((HEIGHT, WIDTH), bool)
        mask[: HEIGHT // 4] = True
        found["gives"] = no_detections()._replace(class_mask=mask)
        picture = self.run(tmp_path, image)
        assert ((picture != 100).any(axis=2) == mask).all()
        assert "person: 25.0% of the picture" in capsys.readouterr().out

    @pytest.mark.usefixtures("found")
    @pytest.mark.parametrize(
        ("more", "expected"),
        [
            (("--labels", " , "), "--labels: expected names separated by commas, got ' , '"),
            (("--min-score", "1.5"), "--min-score: expected 0 to 1, got 1.5"),
            (("--out", "picture.jpg"), "--out: expected a name that ends in .png, got 'picture.jpg'"),
            (("--out", "no/such/folder/picture.png"), "picture.png: cannot be written"),
        ],
    )
    def test_bad_settings(
        self, capsys: pytest.CaptureFixture[str], tmp_path: Path, image: Path, more: tuple[str, ...], expected: str
    ) -> None:
        assert expected in fails(capsys, "check", str(tmp_path / "net.onnx"), str(image), *more)

    def test_bad_files(self, capsys: pytest.CaptureFixture[str], tmp_path: Path, image: Path) -> None:
        (tmp_path / "net.onnx").write_bytes(CONTENT)
        assert "net.onnx: expected an ONNX file" in fails(capsys, "check", str(tmp_path / "net.onnx"), str(image))
        assert "words.png: cannot be read" in fails(
            capsys, "check", str(tmp_path / "net.onnx"), str(tmp_path / "words.png")
        )
        assert "models get yolox-nano" in failing("models", code=2)(capsys, "check", "yolox-nano", str(image))

    def test_known_networks(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """Those that are here are of the family that the table says."""
        if not MODELS:
            pytest.skip("JAXSLAM_MODELS is not set: no networks here")
        monkeypatch.setenv("JAXSLAM_MODELS", MODELS)
        files = {model.adapter: model_zoo.local_file(model) for model in known_models().values()}
        for adapter, file in files.items():
            if file is not None:
                assert models_check.load_detector(file).adapter == adapter


class TestVerdict:
    """Without an image, the command says whether a network is good."""

    @pytest.fixture(autouse=True)
    def elsewhere(self, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
        """Picture files of failing commands have no option `--out` here."""
        monkeypatch.chdir(tmp_path)

    def check(self, *arguments: str | Path, out: Path) -> None:
        main(["models", "check", *map(str, arguments), "--out", str(out / "out.png")])

    def test_good_segmenter(self, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
        encoder, decoder = tiny_segmenters.sam(tmp_path)
        self.check("none", "--prompt-encoder", encoder, "--prompt-decoder", decoder, out=tmp_path)
        out = capsys.readouterr().out
        assert all(word in out for word in ("star", "cross", "bar", "leaf"))
        assert "sam_encoder.onnx, sam_decoder.onnx: good, with a median IoU of 0.70" in out
        picture = cv2.imread(str(tmp_path / "out.png"))
        assert picture is not None
        assert picture.shape == (480, 640, 3)

    def test_bad_segmenter(self, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
        """It paints the boxes that it is asked for."""
        encoder, decoder = map(str, tiny_segmenters.sam(tmp_path, blind=True))
        message = fails(capsys, "check", "none", "--prompt-encoder", encoder, "--prompt-decoder", decoder)
        assert "sam_decoder.onnx: expected a median IoU of at least 0.65" in message
        assert "got 0.40" in message

    def test_json(self, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
        self.check(tiny_segmenters.in_context(tmp_path / "seggpt.onnx", side=112), "--json", out=tmp_path)
        told = json.loads(capsys.readouterr().out)
        assert told["good"]
        assert told["iou"] >= told["least_iou"]
        assert told["ious"].keys() == {"star", "cross", "bar", "leaf"}

    def test_detector(
        self, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
    ) -> None:
        monkeypatch.setattr(models_check, "load_detector", lambda *_, **__: lambda image: no_detections())
        path = tiny_models.yolox(tmp_path / "net.onnx", [])
        assert "net.onnx: expected a median IoU of at least 0.68" in fails(capsys, "check", str(path))

    @pytest.mark.parametrize(
        ("arguments", "expected"),
        [
            (("none", "--prompt-encoder", "e.onnx"), "--prompt-decoder: expected what belongs to --prompt-encoder"),
            (("none", "--prompt-decoder", "d.onnx"), "--prompt-encoder: expected what belongs to --prompt-decoder"),
            (
                ("net.onnx", "--prompt-encoder", "e.onnx", "--prompt-decoder", "d.onnx"),
                "FILE: expected none with prompts and without an image, got 'net.onnx'",
            ),
            (("net.onnx", "--labels", "car"), "IMAGE: expected an image for --labels, got none"),
            (("none", "--examples", "e.yaml"), "IMAGE: expected an image for --examples, got none"),
        ],
    )
    def test_needs(self, capsys: pytest.CaptureFixture[str], arguments: tuple[str, ...], expected: str) -> None:
        assert expected in fails(capsys, "check", *arguments)


class TestDrawing:
    image = np.full((HEIGHT, WIDTH, 3), 100, np.uint8)

    def test_leaves_the_image_alone(self) -> None:
        before = self.image.copy()
        assert (draw_detections(self.image, two_people()) != before).any()
        assert (self.image == before).all()

    def test_same_bytes_again(self) -> None:
        once, again = (draw_detections(self.image, two_people()) for _ in range(2))
        assert once.dtype == np.uint8
        assert (once == again).all()

    @pytest.mark.parametrize("scale", [1, 4, 8])
    def test_edges_are_those_of_the_box(self, scale: int) -> None:
        """The outer edges of its lines, however wide those are."""
        image = np.full((scale * HEIGHT, scale * WIDTH, 3), 100, np.uint8)
        one = Detections(scale * two_people().boxes[:1], np.ones(1, np.float32), ("",), None, None)
        below_the_text = (draw_detections(image, one) != image).any(axis=2)[70 * scale :]
        rows, columns = np.nonzero(below_the_text)
        edges = np.array([columns.min(), columns.max() + 1, rows.max() + 1 + 70 * scale])
        assert edges.tolist() == [40 * scale, 80 * scale, 110 * scale]

    @pytest.mark.parametrize("shift", [(-300, -300), (300, 300), (0, -100), (150, 0)])
    def test_text_stays_inside(self, shift: tuple[int, int]) -> None:
        """A box out of sight still has its label in the picture, whole."""
        box = two_people().boxes[:1] + np.array([*shift, *shift], np.float32)
        one = Detections(box, np.ones(1, np.float32), ("person",), None, None)
        changed = (draw_detections(self.image, one) == 0).all(axis=2)  # the text is black
        at_home = draw_detections(self.image, one._replace(boxes=two_people().boxes[:1]))
        assert changed.sum() > 0.8 * (at_home == 0).all(axis=2).sum() > 0

    def test_texts_do_not_hide_each_other(self) -> None:
        three = Detections(np.tile(two_people().boxes[:1], (3, 1)), np.ones(3, np.float32), ("person",) * 3, None, None)
        one = three._replace(boxes=three.boxes[:1], scores=three.scores[:1], labels=("person",))
        black = [(draw_detections(self.image, some) == 0).all(axis=2).sum() for some in (one, three)]
        assert black[1] == 3 * black[0] > 0

    def test_many(self) -> None:
        boxes = np.tile(two_people().boxes, (50, 1))
        crowd = Detections(boxes, np.linspace(1, 0, 100, dtype=np.float32), ("person",) * 100, None, None)
        assert (draw_detections(self.image, crowd) != self.image).any()
