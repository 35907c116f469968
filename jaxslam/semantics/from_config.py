"""Make the detector that the settings name."""

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
"""Value of `semantics.model` for the true masks of a rendered room, from `datasets.synthetic.with_true_masks`."""

_NO_NETWORK = "no network finds what moves, geometry alone decides"
_BY_DEPTH = "masks are made by depth"
_GO_ON = "To go on without it: --allow-missing-model, in Python semantics.missing_model=allow"
_log = logging.getLogger(__name__)


def detector_of(config: SemanticsConfig, num_threads: int = 1) -> Detector | None:
    """Load the detector of the settings, with a promptable segmenter if the settings name one.

    Args:
        config: Settings of the networks.
        num_threads: Number of threads of each network, if the settings leave it open.

    Returns:
        The detector; `None` if the settings name no network, or one that is missing and may be.

    Raises:
        ConfigError: If the settings name the true masks of a rendered room, or settings of prompts contradict.
        MissingModelError: If a known network is not on this machine, and `missing_model` does not allow that.
        ModelError: If a file is missing or cannot be used.
        DatasetError: If an image of an example cannot be read.
    """
    if config.model == SCENE:
        raise ConfigError(f"semantics.model: expected a network, got '{SCENE}', which knows rendered rooms only")
    threads = config.threads or num_threads
    segmenter = _segmenter_of(config, threads)
    path = None if config.model is None else _found(config, "model", _NO_NETWORK)
    examples = [] if config.examples is None else read_examples(Path(config.examples))
    shown = [each.image is not None for each in examples]
    if any(shown) and not all(shown):
        raise ConfigError(f"{config.examples}: expected all examples with an image, or all without, got both")
    if any(shown):
        return _like_examples(config, path, segmenter, examples, threads)
    detector = None if path is None else _with_labels(config, path, threads)
    return _prompted(config, detector, segmenter, [each for one in examples for each in one.prompts])


def _with_labels(config: SemanticsConfig, path: Path, threads: int) -> OnnxDetector:
    """Load the detector of the wanted classes, and log those that the network does not know."""
    detector = load_detector(path, labels=config.labels, min_score=config.min_score, num_threads=threads)
    if detector.missing_labels:
        missing, known = ", ".join(detector.missing_labels), ", ".join(detector.labels)
        _log.warning("%s does not know these classes: %s. It looks for: %s", path.name, missing, known)
    return detector


def _like_examples(
    config: SemanticsConfig,
    path: Path | None,
    segmenter: PromptSegmenter | None,
    examples: Sequence[Example],
    threads: int,
) -> Detector | None:
    """Load an in-context segmenter; the promptable segmenter only makes the masks of examples without one."""
    if config.model is None:
        raise ConfigError("semantics.model: expected an in-context segmenter for semantics.examples, got null")
    if path is None:
        return None
    shown = with_masks(examples, segmenter)
    return load_in_context(path, shown, min_score=config.min_score, num_threads=threads)


def _prompted(
    config: SemanticsConfig,
    detector: OnnxDetector | None,
    segmenter: PromptSegmenter | None,
    prompts: Sequence[Prompt],
) -> Detector | None:
    """Add the promptable segmenter, if there is one, to a detector and the prompts of every frame."""
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


def _segmenter_of(config: SemanticsConfig, threads: int) -> PromptSegmenter | None:
    """Load the promptable segmenter of the settings; `None` if there is none or it is missing and may be."""
    named = {"prompt_encoder": config.prompt_encoder, "prompt_decoder": config.prompt_decoder}
    if None in named.values():
        missing, given = sorted(named, key=lambda key: named[key] is not None)
        if named[given] is not None:
            raise ConfigError(f"semantics.{missing}: expected what belongs to semantics.{given}, got null")
        return None
    encoder, decoder = (_found(config, key, _BY_DEPTH) for key in named)
    if encoder is None or decoder is None:
        return None
    return load_segmenter(encoder, decoder, num_threads=threads)


def network_files(config: SemanticsConfig) -> dict[str, Path | None]:
    """Find the files of all networks of the settings, by setting; `None` for one that is missing and may be.

    Raises:
        MissingModelError: If a known network is not on this machine, and `missing_model` does not allow that.
        ModelError: If a named file does not exist.
    """
    settings = ("model", "prompt_encoder", "prompt_decoder")
    return {setting: _found(config, setting) for setting in settings if getattr(config, setting) not in (None, SCENE)}


def why_no_network(config: SemanticsConfig) -> str | None:
    """Explain, as a part of a sentence, why no network runs with these settings; `None` if one does.

    Raises:
        ModelError: For the same reasons as in `network_files`.
    """
    files = network_files(config)
    if config.model == SCENE or files.get("model") is not None:
        return None
    missing = [getattr(config, setting) for setting, path in files.items() if path is None]
    if missing:
        return f"{' and '.join(missing)} not on this machine"
    return None if files else "semantics.model is null"


def preset_needs_network(preset: str) -> bool:
    """Return whether a preset is a system built around a network, which without one would be another system.

    Raises:
        ConfigError: If the preset does not exist.
    """
    semantics = load_config(preset).semantics
    return semantics.model is not None and semantics.missing_model == "error"


def _found(config: SemanticsConfig, setting: str, otherwise: str | None = None) -> Path | None:
    """Find the file of the network that a setting names; `None` if it is missing and may be.

    Args:
        config: Settings of the networks.
        setting: Name of the setting.
        otherwise: Consequence of a missing network, which is logged as a warning; `None` to log nothing.
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
    """Load the detector of the objects that the dense map holds at full density; `None` if the settings name none.

    Raises:
        ModelError: For the same reasons as in `detector_of`.
    """
    dense, semantics = config.dense, config.semantics
    if not dense.enabled or not dense.key_classes:
        return None
    return detector_of(dataclasses.replace(semantics, labels=dense.key_classes), config.run.threads)
