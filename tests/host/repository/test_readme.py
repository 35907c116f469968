"""README and CONTRIBUTING say what is true: every block runs, in order, in one folder; every table is complete.

Everything runs in processes of its own, as for a reader; commands with JAX's strict rules, as all tests, and Python as
JAX comes. `.venv` is the environment of the tests, so of the two set-up lines only what follows `pip install` runs
here: `test_wheel` installs, `.ci/run` runs the second line itself.
"""

import os
import re
import shlex
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

import pytest
import readers_jax
from result_files import FILES, MASK_FILES

from jaxslam import Camera, TrackParams, TrackPlan, TrackStatus
from jaxslam.results.dense_results import DENSE_FILES
from jaxslam.semantics.prompted import read_examples

ROOT = Path(__file__).resolve().parents[3]
README = ROOT / "README.md"
CONTRIBUTING = ROOT / ".github" / "CONTRIBUTING.md"
_FENCED = re.compile(r"^```(\w*)\n(.*?)^```$", re.DOTALL | re.MULTILINE)
_SET_UP = re.compile(r"^python -m venv \.venv && \.venv/bin/pip install (?:\.|-e '\.\[dev\]') && ")


class _Block(NamedTuple):
    language: str
    text: str
    line: int


def _blocks(path: Path) -> list[_Block]:
    text = path.read_text(encoding="utf-8")
    return [_Block(match[1], match[2], text.count("\n", 0, match.start()) + 2) for match in _FENCED.finditer(text)]


def _run(arguments: list[str], folder: Path, what: str, rules: Mapping[str, str] = MappingProxyType({})) -> str:
    environment = os.environ | {"NO_COLOR": "1"} | dict(rules)
    done = subprocess.run(arguments, cwd=folder, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, f"{what} failed:\n{done.stdout}\n{done.stderr}"
    return done.stdout


def _run_block(block: _Block, folder: Path) -> str:
    what = f"README.md:{block.line}"
    if block.language == "yaml":
        name = block.text.partition("\n")[0].removeprefix("# ")
        (folder / name).write_text(block.text)
        return ""
    if block.language == "python":
        return _run([sys.executable, "-W", "error", "-c", block.text], folder, what, readers_jax.ENVIRONMENT)
    assert block.language == "bash", f"{what}: no way to run a block in '{block.language}'"
    command = _SET_UP.sub("", block.text)
    return (
        "" if command.strip() == ".venv/bin/pytest" else _run(["bash", "-euo", "pipefail", "-c", command], folder, what)
    )


def test_blocks_run_in_order(tmp_path: Path) -> None:
    (tmp_path / ".venv").symlink_to(sys.prefix)
    printed = {block.line: _run_block(block, tmp_path) for block in _blocks(README)}
    text = "".join(printed.values())
    assert len(printed) == 17
    assert "ATE" in text
    left_behind = {path.name for path in (tmp_path / "results" / "demo").iterdir()}
    assert left_behind == FILES | MASK_FILES
    assert all(f"`{name}`" in README.read_text(encoding="utf-8") for name in left_behind)
    assert all((tmp_path / "results" / "dense" / name).is_file() for name in DENSE_FILES)
    assert (tmp_path / "ate.png").is_file()
    assert Camera.load(tmp_path / "my_camera.yaml").depth_scale_per_m == 5000
    assert [example.label for example in read_examples(tmp_path / "examples.yaml")] == ["arm", "arm"]
    last = [block.line for block in _blocks(README) if block.language == "python"][-1]
    gradient = [float(word) for word in printed[last].split()]
    assert len(gradient) == 2
    assert all(abs(value) > 0 for value in gradient)


def test_snippets_are_short() -> None:
    _, _, loop, gradient = (block.text for block in _blocks(README) if block.language == "python")
    count = lambda code: sum(bool(line.strip()) for line in code.splitlines())
    assert "slam.track(frame)" in loop
    assert count(loop) <= 12
    assert "track_step(" in gradient
    assert count(gradient) <= 15


def test_first_line_to_run_sets_everything_up() -> None:
    lines = [line for block in _blocks(README) for line in block.text.splitlines() if line.startswith("python -m venv")]
    assert len(lines) == 2
    assert all(_SET_UP.match(line) for line in lines)
    assert [line.endswith(".venv/bin/pytest") for line in lines] == [False, True]  # .ci/run looks for just one


def test_table_of_traced_and_static_settings_is_complete() -> None:
    rows = {row.split(",")[0]: row for row in README.read_text(encoding="utf-8").splitlines() if row.startswith("| ")}
    named = lambda kind: re.findall(r"`(\w+)`", rows[kind].split("|")[2])
    assert named("| traced") == list(TrackParams._fields)
    assert named("| static") == list(TrackPlan._fields)


def test_table_of_statuses_is_complete() -> None:
    rows = re.findall(r"^\| `([A-Z]+)` \|", README.read_text(encoding="utf-8"), re.MULTILINE)
    assert sorted(rows) == sorted(status.name for status in TrackStatus)


@pytest.mark.parametrize("path", [README, CONTRIBUTING], ids=lambda path: path.stem)
def test_links_lead_somewhere(path: Path) -> None:
    text = path.read_text(encoding="utf-8")
    headings = {heading.lower().replace(" ", "-") for heading in re.findall(r"^#+ (.*)$", text, re.MULTILINE)}
    for target in re.findall(r"\]\(([^)]+)\)", text):
        if target.startswith("#"):
            assert target[1:] in headings, target
        elif not target.startswith("https://"):
            assert (path.parent / target).exists(), target


@pytest.mark.parametrize("line", [line for block in _blocks(CONTRIBUTING) for line in block.text.splitlines()])
def test_contributing_names_what_exists(line: str) -> None:
    """These lines clone, set up, install a hook or run this very suite: here their programs and folders must exist."""
    command = shlex.split(line, comments=True)
    installed = Path(sys.prefix) / "bin" / command[0].removeprefix(".venv/bin/")
    assert installed.is_file() or (ROOT / command[0]).is_file() or command[0] == "git"
    assert all((ROOT / word).exists() for word in command[1:] if word.startswith("tests"))
