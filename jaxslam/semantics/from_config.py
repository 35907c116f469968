"""The detector that the settings ask for."""

import dataclasses
import logging
from collections.abc import Sequence
from pathlib import Path

from jaxslam.config.loading import load_config
from jaxslam.config.schema import Config, SemanticsConfig
from jaxslam.errors import ConfigError, MissingModelError, ModelError
from jaxslam.semantics import Detector, OnnxDetector, load_detector
from jaxslam.semantics.adapters.class_map import ClassMap
from jaxslam.semantics.model_zoo import DEFAULT_MODEL, find_model, is_known
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

_NO_NETWORK = "no network finds what moves, geometry alone decides"
_BY_DEPTH = "masks are made by depth"
_GO_ON = "To go on without it: --allow-missing-model, in Python semantics.missing_model=allow"
_log = logging.getLogger(__name__)


def detector_of(config: SemanticsConfig) -> Detector | None:
    """The network of the settings, with masks by prompts if they ask for that.

    Returns:
        `None` if they name none, or one that is not on this machine and that they allow to be missing.

    Raises:
        ConfigError: If they name the truth of a rendered room, or settings of prompts do not fit together.
        MissingModelError: If a known network is not on this machine, and `missing_model` does not allow that.
        ModelError: If a file is named that is not there, or that cannot be used.
        DatasetError: If an image of an example cannot be read.
    """
    if config.model == SCENE:
        raise ConfigError(f"semantics.model: expected a network, got '{SCENE}', which knows rendered rooms only")
    segmenter = _segmenter_of(config)
    path = None if config.model is None else _found(config, "model", _NO_NETWORK)
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
    """The promptable segmenter of the settings; `None` if there is none, and a warning if it may be missing and is."""
    named = {"prompt_encoder": config.prompt_encoder, "prompt_decoder": config.prompt_decoder}
    if None in named.values():
        missing, given = sorted(named, key=lambda key: named[key] is not None)
        if named[given] is not None:
            raise ConfigError(f"semantics.{missing}: expected what belongs to semantics.{given}, got null")
        return None
    encoder, decoder = (_found(config, key, _BY_DEPTH) for key in named)
    if encoder is None or decoder is None:
        return None
    return load_segmenter(encoder, decoder, num_threads=config.threads)


def network_files(config: SemanticsConfig) -> dict[str, Path | None]:
    """The files of all networks that the settings name, by setting; `None` for one that may be missing and is.

    Raises:
        MissingModelError: If a known network is not on this machine, and `missing_model` does not allow that.
        ModelError: If a file is named that is not there.
    """
    settings = ("model", "prompt_encoder", "prompt_decoder")
    return {setting: _found(config, setting) for setting in settings if getattr(config, setting) not in (None, SCENE)}


def why_no_network(config: SemanticsConfig) -> str | None:
    """Why no network looks at frames with these settings, as a part of a sentence; `None` if one does.

    Raises:
        ModelError: As `network_files`.
    """
    files = network_files(config)
    if config.model == SCENE or files.get("model") is not None:
        return None
    missing = [getattr(config, setting) for setting, path in files.items() if path is None]
    if missing:
        return f"{' and '.join(missing)} not on this machine"
    return None if files else "semantics.model is null"


def preset_needs_network(preset: str) -> bool:
    """Whether a preset is a system built around a network, so that without one it is another system.

    Raises:
        ConfigError: If there is no such preset.
    """
    semantics = load_config(preset).semantics
    return semantics.model is not None and semantics.missing_model == "error"


def _found(config: SemanticsConfig, setting: str, otherwise: str | None = None) -> Path | None:
    """The file of the network that a setting names; `None` if it may be missing and is.

    Args:
        config: Settings.
        setting: Name of the one that names the network.
        otherwise: What is done without it, to be logged as a warning; `None` to log nothing.
    """
    name = getattr(config, setting)
    try:
        return find_model(name)
    except ModelError as error:
        if not is_known(name):
            raise
        if config.missing_model != "allow" and (config.missing_model == "error" or name != DEFAULT_MODEL):
            raise MissingModelError(f"semantics.{setting}: {error}. {_GO_ON}") from None
        if otherwise is not None:
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
