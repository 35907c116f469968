"""The detector that the settings ask for."""

import dataclasses
import logging
from collections.abc import Sequence
from pathlib import Path

from jaxslam.config import Config, SemanticsConfig
from jaxslam.errors import ConfigError, ModelError
from jaxslam.known_models import find_model, is_known
from jaxslam.semantics import Detector, OnnxDetector, load_detector
from jaxslam.semantics.adapters.class_map import ClassMap
from jaxslam.semantics.prompted import (
    Example,
    Prompt,
    PromptedDetector,
    PromptSegmenter,
    load_in_context,
    load_segmenter,
    read_examples,
    with_masks,
)

SCENE = "scene"
"""The model that is no network: the truth of a rendered room, see `jaxslam.datasets.synthetic.with_true_masks`."""

_BY_DEPTH = "masks are made by depth"
_log = logging.getLogger(__name__)


def detector_of(config: SemanticsConfig) -> Detector | None:
    """The network of the settings, with masks by prompts if they ask for that.

    Returns:
        `None` if they name none, or one that is known but not on this machine.

    Raises:
        ConfigError: If they name the truth of a rendered room, or settings of prompts do not fit together.
        ModelError: If a file is named that is not there, or that cannot be used.
        DatasetError: If an image of an example cannot be read.
    """
    if config.model == SCENE:
        raise ConfigError(f"semantics.model: expected a network, got '{SCENE}', which knows rendered rooms only")
    segmenter = _segmenter_of(config)
    path = model_file(config)
    examples = [] if config.examples is None else read_examples(Path(config.examples))
    shown = [each.image is not None for each in examples]
    if any(shown) and not all(shown):
        raise ConfigError(f"{config.examples}: expected all examples with an image, or all without, got both")
    if any(shown):
        return _like_examples(config, path, segmenter, examples)
    labels, threads = config.labels, config.threads
    detector = path and load_detector(path, labels=labels, min_score=config.min_score, num_threads=threads)
    return _prompted(config, detector or None, segmenter, [each for one in examples for each in one.prompts])


def _like_examples(
    config: SemanticsConfig, path: Path | None, segmenter: PromptSegmenter | None, examples: Sequence[Example]
) -> Detector | None:
    """What finds things like those on images; the promptable segmenter only makes masks of those without."""
    if config.model is None:
        raise ConfigError("semantics.model: expected an in-context segmenter for semantics.examples, got null")
    if path is None:
        return None
    shown = with_masks(examples, segmenter)
    return load_in_context(path, shown, min_score=config.min_score, num_threads=config.threads)


def _prompted(
    config: SemanticsConfig,
    detector: OnnxDetector | None,
    segmenter: PromptSegmenter | None,
    prompts: Sequence[Prompt],
) -> Detector | None:
    """A detector whose boxes, with the prompts of every frame, are made masks, if there is what makes them."""
    if config.prompt_encoder is None:
        if prompts:
            expected = "images to find the like of, or semantics.prompt_encoder to segment boxes and points"
            raise ConfigError(f"semantics.examples: expected {expected}, got boxes and points alone")
        return detector
    if config.model is None and not prompts:
        sources = "semantics.model, whose boxes are prompts, or prompts by semantics.examples"
        raise ConfigError(f"semantics.prompt_encoder: expected {sources}, got neither")
    if detector is not None and detector.adapter == ClassMap.name:
        raise ConfigError(
            f"semantics.model: expected boxes for semantics.prompt_encoder, got the map of {detector.path}"
        )
    if segmenter is None or (detector is None and not prompts):
        return detector
    return PromptedDetector(segmenter, detector, prompts=prompts, min_iou=config.prompt_min_iou)


def _segmenter_of(config: SemanticsConfig) -> PromptSegmenter | None:
    """The promptable segmenter of the settings; `None` if there is none, and a warning if it is known but not here."""
    named = {"prompt_encoder": config.prompt_encoder, "prompt_decoder": config.prompt_decoder}
    if None in named.values():
        missing, given = sorted(named, key=lambda key: named[key] is not None)
        if named[given] is not None:
            raise ConfigError(f"semantics.{missing}: expected what belongs to semantics.{given}, got null")
        return None
    encoder, decoder = (_found(name, _BY_DEPTH) for name in named.values() if name is not None)
    if encoder is None or decoder is None:
        return None
    return load_segmenter(encoder, decoder, num_threads=config.threads)


def model_file(config: SemanticsConfig) -> Path | None:
    """The file of the network of the settings; `None` if there is none, and a warning if it is known but not here.

    Raises:
        ModelError: If a file is named that is not there.
    """
    if config.model is None or config.model == SCENE:
        return None
    return _found(config.model, "no network finds what moves, geometry alone decides")


def network_files(config: SemanticsConfig) -> dict[str, Path | None]:
    """The files of all networks that the settings name, by setting; `None` for one that is known but not here.

    Raises:
        ModelError: If a file is named that is not there.
    """
    found = {} if config.model in (None, SCENE) else {"model": model_file(config)}
    prompt = {"prompt_encoder": config.prompt_encoder, "prompt_decoder": config.prompt_decoder}
    return found | {key: _found(name, _BY_DEPTH) for key, name in prompt.items() if name is not None}


def _found(name: str, otherwise: str) -> Path | None:
    try:
        return find_model(name)
    except ModelError as error:
        if not is_known(name):
            raise
        _log.warning("%s: %s", otherwise, error)
        return None


def key_detector_of(config: Config) -> Detector | None:
    """The detector of the objects that a dense map has at full density; `None` if the settings ask for none.

    Raises:
        ModelError: As `detector_of`.
    """
    dense, semantics = config.dense, config.semantics
    if not dense.enabled or not dense.key_classes:
        return None
    return detector_of(dataclasses.replace(semantics, labels=dense.key_classes))
