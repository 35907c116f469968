"""The README is short, and what it says is true: its blocks run in order, and CONTRIBUTING names what exists."""

import re
import shlex
import sys
from pathlib import Path

import pytest
from doc_blocks import README, ROOT, SET_UP, blocks, prose, run_block, set_up
from result_files import FILES, MASK_FILES

CONTRIBUTING = ROOT / ".github" / "CONTRIBUTING.md"
_MOST_LINES, _MOST_WORDS = 150, 1200


def test_blocks_run_in_order(tmp_path: Path) -> None:
    """The snippet has JAX's strict rules, to load what the demo compiled; notebooks run with JAX's defaults."""
    set_up(tmp_path)
    printed = [run_block(block, tmp_path, python={}) for block in blocks(README)]
    assert len(printed) == 3
    assert "ATE" in printed[0]
    assert {path.name for path in (tmp_path / "results" / "demo").iterdir()} == FILES | MASK_FILES
    assert "map points" in printed[2]
    assert (tmp_path / "room.npz").is_file()


def test_is_short() -> None:
    text = README.read_text(encoding="utf-8")
    assert len(text.splitlines()) <= _MOST_LINES
    assert len(text.split()) <= _MOST_WORDS


def test_snippet_is_short() -> None:
    (snippet,) = (block.text for block in blocks(README) if block.language == "python")
    assert "slam.track(frame)" in snippet
    assert sum(bool(line.strip()) for line in snippet.splitlines()) <= 12


def test_picture_is_there_and_small() -> None:
    (target,) = re.findall(r"!\[[^]]+\]\(([^)]+)\)", prose(README))
    assert (ROOT / target).stat().st_size < 200_000


def test_first_line_to_run_sets_everything_up() -> None:
    lines = [line for block in blocks(README) for line in block.text.splitlines() if line.startswith("python -m venv")]
    assert len(lines) == 2
    assert all(SET_UP.match(line) for line in lines)
    assert [line.endswith(".venv/bin/pytest") for line in lines] == [False, True]  # .ci/run looks for just one


@pytest.mark.parametrize("line", [line for block in blocks(CONTRIBUTING) for line in block.text.splitlines()])
def test_contributing_names_what_exists(line: str) -> None:
    """These lines clone, set up, install a hook or run this very suite: here their programs and folders must exist."""
    command = shlex.split(line, comments=True)
    installed = Path(sys.prefix) / "bin" / command[0].removeprefix(".venv/bin/")
    assert installed.is_file() or (ROOT / command[0]).is_file() or command[0] == "git"
    assert all((ROOT / word).exists() for word in command[1:] if word.startswith("tests"))
