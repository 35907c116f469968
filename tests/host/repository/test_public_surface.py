"""The names that users depend on change only on purpose: the public surface equals the stored one."""

import json
import re

from public_surface import ADVICE, ROOT, differences, public_surface, read_surface

_ROW = re.compile(r"^\| (?!where|---|kernels)(.*?) \| (.*?) \| (.*?) \|$", re.MULTILINE)
"""A row of the changelog's table of changed names: where, before and now. The kernels have no surface here."""


def test_public_surface_is_the_stored_one() -> None:
    lines = differences(read_surface(), public_surface())
    assert not lines, "\n".join([*lines, ADVICE])


def test_differences_are_told_apart() -> None:
    old = {"codes": {"Status.OK": "0", "Status.LOST": "2"}, "settings": {"key seed": "int = 0"}}
    new = {"codes": {"Status.OK": "1", "Status.GONE": "2"}, "settings": {"key seed": "int = 0"}}
    assert differences(old, new) == [
        "codes: removed: Status.LOST: 2",
        "codes: added: Status.GONE: 2",
        "codes: changed: Status.OK: 0 -> 1",
    ]
    assert not differences(old, old)


def test_table_of_changed_names_is_true() -> None:
    """What it calls a present name is part of the surface, and an earlier setting or Python name is not."""
    rows = _ROW.findall((ROOT / "CHANGELOG.md").read_text(encoding="utf-8"))
    assert {"Python", "status", "setting", "map file", "`summary.json`", "`frames.csv`"} <= {row[0] for row in rows}
    surface = read_surface()
    entries = {name.removeprefix("key ") for part in surface.values() for name in part}
    words = set(re.findall(r"\w+", json.dumps(surface)))
    for where, before, now in rows:
        for name in re.findall(r"`([^`]+)`", now):
            assert re.findall(r"\w+", name)[-1] in words, name
        if where in ("Python", "setting", "status"):
            assert not entries.intersection(re.findall(r"`([^`]+)`", before)), before
