"""`jaxslam models check`: what a network finds in an image, or whether it is good; and how long it takes."""

import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import cv2
import numpy as np
import tyro

from jaxslam.cli.console import make_table, plain_console, print_json
from jaxslam.cli.shared_options import WithJson
from jaxslam.config.schema import SemanticsConfig
from jaxslam.errors import ConfigError, ModelError
from jaxslam.io.atomic_files import write_atomically
from jaxslam.semantics import Detections, Detector, OnnxDetector, load_detector
from jaxslam.semantics.model_zoo import find_model
from jaxslam.visualization.draw_detections import draw_detections

if TYPE_CHECKING:
    from jaxslam.semantics.network_check import NetworkCheck

_REPEATS = 5
_NONE = "none"


@dataclass(frozen=True)
class CheckModel(WithJson):
    """Options of `jaxslam models check`."""

    file: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="FILE")]
    """Model file (ONNX), or the name of a known model; with `--prompt-encoder` its boxes are prompts, and `none` is for
    prompts of `--examples` alone."""
    image: Annotated[Path | None, tyro.conf.Positional, tyro.conf.arg(metavar="[IMAGE]")] = None
    """Image to look at. Without one, the network looks at a picture that comes with jaxslam, in which it is known what
    is there; the command fails if the network does not find it."""
    out: Path = Path("detections.png")
    """PNG to draw to."""
    labels: str = "person"
    """Classes to look for, separated by commas: names of COCO, of PASCAL VOC or of the network's own, or groups such as
    `vehicles`."""
    adapter: str | None = None
    """What reads the outputs of the network; recognized from them if not given."""
    min_score: float = 0.3
    """Leave out what is less sure than this, 0 to 1."""
    prompt_encoder: str | None = None
    """Encoder of a promptable segmenter, which makes masks: model file, or the name of a known model."""
    prompt_decoder: str | None = None
    """Its decoder."""
    examples: Path | None = None
    """YAML file or folder of examples: for an in-context segmenter images with masks, else boxes and points."""

    def main(self) -> None:
        """Run the command."""
        labels = tuple(label for label in map(str.strip, self.labels.split(",")) if label)
        if not labels:
            raise ConfigError(f"--labels: expected names separated by commas, got '{self.labels}'")
        if not 0 <= self.min_score <= 1:
            raise ConfigError(f"--min-score: expected 0 to 1, got {self.min_score}")
        if self.out.suffix.lower() != ".png":
            raise ConfigError(f"--out: expected a name that ends in .png, got '{self.out}'")
        if self.image is None:
            self._judge(labels)
            return
        from jaxslam.sensors.image_files import read_color  # noqa: PLC0415 - with JAX, which `--help` does without

        image = read_color(self.image)
        detector, files = self._detector(labels)
        found, first_ms, median_ms = _timed(detector, image)
        if self.json:
            times = {"median_ms": median_ms, "first_ms": first_ms}
            print_json({**_figures(found), **times, "files": list(map(str, files)), "picture": str(self.out)})
        else:
            _print_found(found, labels, self.min_score)
        if isinstance(detector, OnnxDetector) and detector.missing_labels:
            plain_console.print(f"The network does not know: {', '.join(detector.missing_labels)}.")
        plain_console.print(f"{median_ms:.1f} ms an image, the first {first_ms:.1f} ms ({', '.join(map(str, files))})")
        self._draw(image, found)

    def _judge(self, labels: tuple[str, ...]) -> None:
        """Check the network on a picture that comes with jaxslam.

        Raises:
            ModelError: If it does not find what is there.
        """
        from jaxslam.semantics.network_check import LABEL  # noqa: PLC0415 - with ONNX, which `--help` does without

        if self.examples is not None or labels != (LABEL,):
            got = "--labels" if self.examples is None else "--examples"
            raise ConfigError(f"IMAGE: expected an image for {got}, got none")
        check, files = self._checked()
        if self.json:
            shown = dict(zip(check.things, check.ious, strict=True))
            print_json({"good": check.good, "iou": check.iou, "least_iou": check.least, "ious": shown})
        else:
            table = make_table("Found of what is in the picture", "thing", "IoU")
            for thing, iou in zip(check.things, check.ious, strict=True):
                table.add_row(thing, f"{iou:.2f}")
            plain_console.print(table)
        self._draw(check.picture, check.found)
        names = ", ".join(file.name for file in files)
        if not check.good:
            raise ModelError(
                f"{names}: expected a median IoU of at least {check.least:g} with what is in the picture, got"
                f" {check.iou:.2f}; not trained, damaged, or exported with other inputs"
            )
        plain_console.print(f"{names}: good, with a median IoU of {check.iou:.2f}")

    def _checked(self) -> "tuple[NetworkCheck, list[Path]]":
        """Check the promptable segmenter if one is given, else the network, of either kind."""
        from jaxslam.semantics import network_check  # noqa: PLC0415 - with ONNX
        from jaxslam.semantics.prompted import load_segmenter  # noqa: PLC0415 - with ONNX

        prompts = self.prompt_encoder is not None or self.prompt_decoder is not None
        for option, given in (("FILE", self.file if self.file != _NONE else None), ("--adapter", self.adapter)):
            if prompts and given is not None:
                raise ConfigError(f"{option}: expected none with prompts and without an image, got '{given}'")
        if self.prompt_encoder is not None and self.prompt_decoder is not None:
            files = [find_model(name) for name in (self.prompt_encoder, self.prompt_decoder)]
            return network_check.check_segmenter(load_segmenter(*files)), files
        if prompts:
            given, other = ("encoder", "decoder")[:: 1 if self.prompt_decoder is None else -1]
            raise ConfigError(f"--prompt-{other}: expected what belongs to --prompt-{given}, got none")
        path = find_model(self.file)
        if network_check.is_example_network(path):
            return network_check.check_in_context(path), [path]
        detector = load_detector(path, labels=(network_check.LABEL,), min_score=self.min_score, adapter=self.adapter)
        return network_check.check_detector(detector), [path]

    def _draw(self, image: np.ndarray, found: Detections) -> None:
        bgr = cv2.cvtColor(draw_detections(image, found), cv2.COLOR_RGB2BGR)
        write_atomically(self.out, cv2.imencode(".png", bgr)[1].tobytes())
        plain_console.print(f"Picture: {self.out}")

    def _detector(self, labels: tuple[str, ...]) -> tuple[Detector, list[Path]]:
        """Return the detector and the files of its networks; unlike in a run, a missing known network is an error."""
        prompts = (self.prompt_encoder, self.prompt_decoder)
        if self.examples is None and prompts == (None, None):
            path = find_model(self.file)
            return load_detector(path, labels=labels, min_score=self.min_score, adapter=self.adapter), [path]
        if self.adapter is not None:
            raise ConfigError(f"--adapter: expected none with prompts or examples, got '{self.adapter}'")
        model = None if self.file == _NONE else self.file
        files = [find_model(name) for name in (model, *prompts) if name is not None]
        settings = SemanticsConfig(
            model=model,
            labels=labels,
            min_score=self.min_score,
            prompt_encoder=self.prompt_encoder,
            prompt_decoder=self.prompt_decoder,
            examples=None if self.examples is None else str(self.examples),
        )
        from jaxslam.semantics.from_config import detector_of  # noqa: PLC0415 - with JAX

        detector = detector_of(settings)
        assert detector is not None  # all files are here
        return detector, files


def _timed(detector: Callable[[np.ndarray], Detections], image: np.ndarray) -> tuple[Detections, float, float]:
    """Run a network; return what it finds, and the milliseconds of the first run and the median of later ones."""
    times_ms: list[float] = []
    found: Any = None
    for _ in range(_REPEATS + 1):
        began_s = time.perf_counter()
        found = detector(image)
        times_ms.append(1e3 * (time.perf_counter() - began_s))
    return found, times_ms[0], statistics.median(times_ms[1:])


def _figures(found: Detections) -> dict[str, Any]:
    """Describe detections for `--json`: boxes in pixels, masks as shares of the image."""
    shares = [None] * len(found.labels) if found.masks is None else found.masks.mean((1, 2)).tolist()
    rows = zip(found.labels, found.scores.tolist(), found.boxes.tolist(), shares, strict=True)
    return {
        "found": [
            {"label": label, "score": score, "box": box, "mask_share": share} for label, score, box, share in rows
        ],
        "class_map_share": None if found.class_mask is None else float(found.class_mask.mean()),
    }


def _print_found(found: Detections, labels: tuple[str, ...], min_score: float) -> None:
    if len(found.labels):
        table = make_table("Found", "label", "score", "left", "top", "right", "bottom", "mask")
        shares = (
            ["-"] * len(found.labels)
            if found.masks is None
            else [f"{share:.1%}" if share else "-" for share in found.masks.mean((1, 2))]
        )
        for label, score, box, share in zip(found.labels, found.scores, found.boxes, shares, strict=True):
            table.add_row(label, f"{score:.2f}", *(f"{edge:.0f}" for edge in box), share)
        plain_console.print(table)
    elif found.class_mask is None:
        plain_console.print(f"Found nothing: no {' or '.join(labels)} with a score of at least {min_score}.")
    if found.class_mask is not None:
        plain_console.print(f"{' or '.join(labels)}: {found.class_mask.mean():.1%} of the picture, by class map")
