"""Runs the fenced blocks of a documentation page in order, in one folder, as a reader would.

Every block runs in a process of its own: commands with JAX's strict rules, as all tests, and Python with JAX's
defaults unless the caller asks for the strict rules too. `.venv` is the environment of the tests. Of the two set-up
lines of the README only what follows `pip install` runs here: `test_wheel` installs, and `.ci/run` runs the second
line itself.
"""

import os
import re
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

import readers_jax

ROOT = Path(__file__).resolve().parents[2]
README = ROOT / "README.md"
DOCS = ROOT / "docs"
PAGES = sorted([*DOCS.glob("*.md"), *DOCS.glob("systems/*.md")])
SET_UP = re.compile(r"^python -m venv \.venv && \.venv/bin/pip install (?:\.|-e '\.\[dev\]') && ")

_FENCED = re.compile(r"^```(\w*)\n(.*?)^```$", re.DOTALL | re.MULTILINE)
_COMMENT = re.compile(r"<!--.*?-->", re.DOTALL)
_LINK = re.compile(r"\]\(([^)]+)\)")
_CODE = re.compile(r"`([^`\n]+)`")


class Block(NamedTuple):
    """One fenced block of a page.

    Attributes:
        language: The word behind the fence.
        text: The lines between the fences.
        place: File and line of its first line, for messages.
    """

    language: str
    text: str
    place: str


def blocks(page: Path) -> list[Block]:
    """The fenced blocks of a page, in order."""
    text = page.read_text(encoding="utf-8")
    return [
        Block(match[1], match[2], f"{page.name}:{text.count(chr(10), 0, match.start()) + 2}")
        for match in _FENCED.finditer(text)
    ]


def prose(page: Path) -> str:
    """The text of a page without its fenced blocks and comments."""
    return _COMMENT.sub("", _FENCED.sub("", page.read_text(encoding="utf-8")))


def code_spans(page: Path) -> list[str]:
    """The texts between single backticks, outside of fenced blocks."""
    return _CODE.findall(prose(page))


def links(page: Path) -> list[str]:
    """The targets of all links and images of a page."""
    return _LINK.findall(prose(page))


def anchors(page: Path) -> set[str]:
    """The anchors of a page's headings, as GitHub makes them."""
    headings = re.findall(r"^#+ (.*)$", _FENCED.sub("", page.read_text(encoding="utf-8")), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


def set_up(folder: Path) -> None:
    """Give a folder the environment that the commands of a page call."""
    (folder / ".venv").symlink_to(sys.prefix)


def run_block(block: Block, folder: Path, python: Mapping[str, str] = readers_jax.ENVIRONMENT) -> str:
    """Run a block in a folder, or write it there if it is a file; returns what it printed.

    Args:
        block: The block. A YAML block is a file whose name stands in its first line, behind `# `.
        folder: Folder to run it in.
        python: Environment variables of Python blocks, on top of those of the tests. With none, Python has the strict
            rules and loads the programs that commands before it compiled.
    """
    if block.language == "yaml":
        name = block.text.partition("\n")[0].removeprefix("# ")
        assert re.fullmatch(r"\w+\.yaml", name), f"{block.place}: expected a file name in the first line, got '{name}'"
        (folder / name).write_text(block.text, encoding="utf-8")
        return ""
    if block.language == "python":
        return _run([sys.executable, "-W", "error", "-c", block.text], folder, block.place, python)
    assert block.language == "bash", f"{block.place}: expected bash, python or yaml, got '{block.language}'"
    command = SET_UP.sub("", block.text)
    if command.strip() == ".venv/bin/pytest":
        return ""
    return _run(["bash", "-euo", "pipefail", "-c", command], folder, block.place)


def _run(arguments: list[str], folder: Path, place: str, environment: Mapping[str, str] = MappingProxyType({})) -> str:
    done = subprocess.run(
        arguments,
        cwd=folder,
        env=os.environ | {"NO_COLOR": "1"} | dict(environment),
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, f"{place} failed:\n{done.stdout}\n{done.stderr}"
    return done.stdout
