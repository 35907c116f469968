"""`jaxslam models list` and `get`: the networks that can be had."""

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from jaxslam.cli.console import download_bar, make_table, plain_console, print_json
from jaxslam.cli.fetch import fetch
from jaxslam.cli.shared_options import WithJson
from jaxslam.errors import ModelError
from jaxslam.io.download import sha256_of
from jaxslam.semantics.model_zoo import (
    DEFAULT_MODEL,
    KnownModel,
    known_model,
    known_models,
    local_file,
    models_dir,
)


@dataclass(frozen=True)
class ListModels(WithJson):
    """Options of `jaxslam models list`."""

    details: bool = False
    """Also print what they are, where they come from, and their SHA-256."""

    def main(self) -> None:
        """Run the command."""
        files = {model.name: local_file(model) for model in known_models().values()}
        if self.json:
            print_json([_listed(model, files[model.name]) for model in known_models().values()])
            return
        table = make_table("Known models", "name", "size", "license", "adapter", "here", left=5)
        for model in known_models().values():
            size = "-" if model.size_bytes is None else f"{model.size_bytes / 1e6:.1f} MB"
            mark = " (default)" if model.name == DEFAULT_MODEL else ""
            absent = "no" if model.url else "to be made"
            table.add_row(model.name + mark, size, model.license, model.adapter, "yes" if files[model.name] else absent)
        plain_console.print(table)
        for name, file in files.items():
            if file is not None:
                plain_console.print(f"{name}: {file}")
        if self.details:
            _print_details()
        plain_console.print(f"Downloads go to {models_dir()}; a folder named by JAXSLAM_MODELS is looked at first.")


@dataclass(frozen=True)
class GetModel:
    """Options of `jaxslam models get`."""

    name: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="NAME")]
    """Name of a known model, as `models list` prints it."""
    force: bool = False
    """Download it even if it is there."""

    def main(self) -> None:
        """Run the command."""
        model, found = known_model(self.name), local_file(known_model(self.name))
        if found is not None and not self.force:
            plain_console.print(f"{model.name} is on this machine: {found}")
            if model.sha256 is not None and sha256_of(found) != model.sha256:
                plain_console.print("It is another file than the published one, which --force downloads.")
            return
        target = models_dir() / model.file
        if model.url is None:
            raise ModelError(f"{model.name} cannot be downloaded; {model.how}. Then place the file at {target}")
        with download_bar() as progress:
            fetch(model, model.url, target, progress, title=model.name)
        checked = "as expected" if model.sha256 else "which nobody has checked: no published one is known"
        plain_console.print(f"{model.name}: {target}, {model.license}, see {model.page}")
        plain_console.print(f"SHA-256 {sha256_of(target)}, {checked}")
        if local_file(model) != target:
            plain_console.print(f"Used before it is, as JAXSLAM_MODELS says: {local_file(model)}")


def _listed(model: KnownModel, file: Path | None) -> dict[str, Any]:
    """A known model for `--json`."""
    here = None if file is None else str(file)
    return {**asdict(model), "default": model.name == DEFAULT_MODEL, "here": here}


def _print_details() -> None:
    for model in known_models().values():
        plain_console.print(f"\n{model.name}: {model.about}; {model.page}")
        plain_console.print(f"  {model.url or model.how}")
        if model.sha256 is not None:
            plain_console.print(f"  SHA-256 {model.sha256}")
    plain_console.print()
