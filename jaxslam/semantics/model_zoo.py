"""Public networks that the detector can run: where they come from, their licenses, and their files on this machine."""

import functools
import os
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import platformdirs

from jaxslam.config.catalog import CatalogEntry, read_catalog
from jaxslam.errors import JaxSlamError, MissingModelError, ModelError, nearest

DEFAULT_MODEL = "yolox-nano"


@dataclass(frozen=True, kw_only=True)
class KnownModel(CatalogEntry):
    """A public network.

    Attributes:
        file: Name of the network's file on this machine.
        adapter: Name of the adapter that reads the network's outputs.

    Raises:
        ModelError: If a field has the wrong type or cannot be right.
    """

    _error: ClassVar[type[JaxSlamError]] = ModelError

    file: str
    adapter: str


@functools.cache
def known_models() -> dict[str, KnownModel]:
    """Read the catalog of networks, `configs/models.yaml`: networks by name, the default one first.

    Raises:
        ModelError: If the file is wrong.
    """
    return read_catalog(KnownModel, "models")


def models_dir() -> Path:
    """Return the folder of downloads: `models` in the user's cache folder for jaxslam."""
    return Path(platformdirs.user_cache_dir("jaxslam", appauthor=False)) / "models"


def is_known(name: str) -> bool:
    """Return whether the catalog has a network of that name, whether or not its file is on this machine."""
    return name in known_models()


def known_model(name: str) -> KnownModel:
    """Look up a network of the catalog by its name.

    Raises:
        ModelError: If the catalog has no such network.
    """
    if not is_known(name):
        raise ModelError(f"expected the name of a known model, got '{name}'{nearest(name, known_models())}")
    return known_models()[name]


def local_file(model: KnownModel) -> Path | None:
    """Find the file of a network in the folder that `JAXSLAM_MODELS` names, or else in `models_dir()`.

    Returns:
        The file; `None` if it is in neither folder.

    Raises:
        ModelError: If `JAXSLAM_MODELS` is set to something other than a folder.
    """
    folders = [models_dir()]
    if chosen := os.environ.get("JAXSLAM_MODELS"):
        if not Path(chosen).is_dir():
            raise ModelError(f"JAXSLAM_MODELS: expected a folder, got '{chosen}'")
        folders.insert(0, Path(chosen))
    names = dict.fromkeys((model.file, f"{model.name}.onnx"))
    return next((path for folder in folders for name in names if (path := folder / name).is_file()), None)


def find_model(name_or_path: str | os.PathLike[str] = DEFAULT_MODEL) -> Path:
    """Find the file of a network.

    Args:
        name_or_path: A file, or the name of a known model. The file of a known model is searched in the folder that
            `JAXSLAM_MODELS` names, then in the user's cache folder, under its published name and as `NAME.onnx`.

    Raises:
        MissingModelError: If a known network is not on this machine. The message says how to obtain it.
        ModelError: If there is neither such a file nor a known network of that name.
    """
    text = os.fspath(name_or_path)
    if Path(text).is_file():
        return Path(text)
    if not is_known(text):
        hint = nearest(text, known_models())
        raise ModelError(f"expected a model file or the name of a known model, got '{text}'{hint}")
    model = known_models()[text]
    found = local_file(model)
    if found is None:
        way = f"to download it: jaxslam models get {text}" if model.url else model.how
        raise MissingModelError(
            f"{text} is not on this machine; {way}. To place it by hand: {models_dir() / model.file}"
        )
    return found
