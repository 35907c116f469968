"""Catalogs: YAML files that list what can be downloaded, such as recordings and networks.

A catalog is a list of groups. The fields of a group hold for all of its entries, which may replace them; in every text,
`{name}` is the name of the entry:

- license: CC BY 4.0
  url: https://example.org/{name}.tgz
  recordings:
    walk: {about: a walk}
"""

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, TypeVar

from jaxslam.config.loading import configs_dir
from jaxslam.config.validation import Range, ValidatedConfig, from_mapping
from jaxslam.io.yaml_files import checked_mapping, read_yaml

_NAME = re.compile(r"[A-Za-z0-9_-]+\Z")
_SHA256 = re.compile(r"[0-9a-f]{64}\Z")


@dataclass(frozen=True, kw_only=True)
class CatalogEntry(ValidatedConfig):
    """One file that can be downloaded, or made.

    Attributes:
        name: Name of the entry in commands and settings: letters, digits, `_` and `-`.
        license: License, as the page words it or as an SPDX identifier.
        page: Web page of the authors.
        about: Description in a few words.
        url: Address of the file; `None` if it cannot be downloaded.
        size_bytes: Size of the file at `url` in bytes; `None` if unknown.
        sha256: SHA-256 of the file at `url`, in hexadecimal; `None` if unknown.
        how: Instructions to obtain the file if there is no `url`.

    Raises:
        JaxSlamError: An error of class `_error`, if a field has the wrong type or cannot be right.
    """

    name: str
    license: str
    page: str
    about: str
    url: str | None = None
    size_bytes: Annotated[int, Range(above=0)] | None = None
    sha256: str | None = None
    how: str = ""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not _NAME.match(self.name):
            raise self._error(f"name: expected letters, digits, _ and -, got {self.name!r:.80}")
        if self.url is None and not self.how:
            raise self._error("url: expected an address, or `how` to obtain the file, got neither")
        if self.url is not None and not self.url.startswith("http"):
            raise self._error(f"url: expected http, got {self.url!r:.80}")
        if self.sha256 is not None and not _SHA256.match(self.sha256):
            raise self._error(f"sha256: expected 64 lowercase hexadecimal digits, got {self.sha256!r:.80}")


_Entry = TypeVar("_Entry", bound=CatalogEntry)


def read_catalog(cls: type[_Entry], entries: str, path: Path | None = None) -> dict[str, _Entry]:
    """Read a catalog.

    Args:
        cls: Class of the entries.
        entries: Key under which a group lists its entries, such as `recordings`.
        path: The YAML file; by default the one that comes with jaxslam and has the name of the key.

    Returns:
        The entries by name, in the order of the file.

    Raises:
        JaxSlamError: An error of the class that `cls` raises, if the file is unreadable, or an entry is incomplete, has
            an unknown key or is listed twice.
    """
    path, error = path or configs_dir() / f"{entries}.yaml", cls._error
    groups = read_yaml(path, error)
    if not isinstance(groups, list):
        raise error(f"{path}: expected a list of groups, got {type(groups).__name__}")
    known: dict[str, _Entry] = {}
    for number, content in enumerate(groups, 1):
        group = checked_mapping(content, f"{path}: group {number}", error)
        place = f"{path}: group {number}: {entries}"
        for name, own in checked_mapping(group.pop(entries, None), place, error).items():
            fields = group | checked_mapping(own, f"{place}: {name}", error) | {"name": name}
            named = {
                key: text.replace("{name}", name) if isinstance(text, str) else text for key, text in fields.items()
            }
            if name in known:
                raise error(f"{place}: {name}: listed twice")
            known[name] = from_mapping(cls, named, f"{place}: {name}")
    return known
