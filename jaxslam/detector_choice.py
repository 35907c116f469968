"""The detector that the settings ask for."""

import logging
from pathlib import Path

from jaxslam.config import SemanticsConfig
from jaxslam.errors import ConfigError, ModelError
from jaxslam.known_models import find_model, is_known
from jaxslam.semantics import Detector, load_detector

SCENE = "scene"
"""The model that is no network: the truth of a rendered room, see `jaxslam.datasets.synthetic.with_true_masks`."""

_log = logging.getLogger(__name__)


def detector_of(config: SemanticsConfig) -> Detector | None:
    """The network of the settings; `None` if they name none, or one that is known but not on this machine.

    Raises:
        ConfigError: If they name the truth of a rendered room.
        ModelError: If a file is named that is not there, or that cannot be used.
    """
    if config.model == SCENE:
        raise ConfigError(f"semantics.model: expected a network, got '{SCENE}', which knows rendered rooms only")
    path = model_file(config)
    if path is None:
        return None
    return load_detector(path, labels=config.labels, min_score=config.min_score, num_threads=config.threads)


def model_file(config: SemanticsConfig) -> Path | None:
    """The file of the network of the settings; `None` if there is none, and a warning if it is known but not here.

    Raises:
        ModelError: If a file is named that is not there.
    """
    if config.model is None or config.model == SCENE:
        return None
    try:
        return find_model(config.model)
    except ModelError as error:
        if not is_known(config.model):
            raise
        _log.warning("no network finds what moves, geometry alone decides: %s", error)
        return None
