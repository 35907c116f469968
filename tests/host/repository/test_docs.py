"""The pages in `docs` are true: blocks run, links lead somewhere, tables are complete, generated ones up to date."""

import importlib.util
import json
import re
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import pytest
from doc_blocks import DOCS, PAGES, README, ROOT, anchors, blocks, code_spans, links, prose, run_block, set_up
from result_files import FILES, MASK_FILES
from test_layers import LAYERS

from jaxslam import Camera, TrackParams, TrackPlan, TrackReason, TrackStatus
from jaxslam.cli.command_table import ExitCode, find_command
from jaxslam.config.loading import presets
from jaxslam.config.schema import Config
from jaxslam.datasets import open_dataset
from jaxslam.results.dense_results import DENSE_FILES
from jaxslam.semantics.prompted import read_examples

CONTRIBUTING = ROOT / ".github" / "CONTRIBUTING.md"
_GETTING_STARTED = DOCS / "getting-started.md"
_RECORDING = "recordings/room"
_QUICK = {"command-line", "determinism-and-caches"}
"""Pages whose blocks take less than 5 s; all others are `slow`."""
_BRITISH = re.compile(
    r"\b\w*(?:colour|centre|neighbour|behaviour|favour|grey|licence|catalogue|labelled|modelled|travell|cancell"
    r"|[a-z]+metre|metres?\b|[a-z]{3,}(?:nis|lis|tis|ris|mis|sis|dis)(?:e[sd]?|ing|ation)\b|analys(?:e[sd]?|ing)\b)\w*",
    re.IGNORECASE,
)
_NOT_BRITISH = re.compile(r"\b(?:precise|promise[sd]?|otherwise|noise|raise[sd]?|likewise|rise[sd]?|arise[sd]?)\b")
_OTHERS_NAMES = ("tree_serialise_leaves",)
_SETTING = re.compile(r"^(?:track|mapping|semantics|dynamics|dense|run)(?:\.\w+)+(?==|$)")
_PATH = re.compile(r"[\w.-]*/[\w./-]+|\w+\.(?:py|md|yaml)")
_WITH_BLOCKS = [page for page in PAGES if blocks(page)]


@pytest.fixture(scope="module")
def rendered(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The recording that getting-started renders, for all pages that use it."""
    folder = tmp_path_factory.mktemp("rendered")
    (block,) = (block for block in blocks(_GETTING_STARTED) if block.language == "python")
    assert _RECORDING in block.text
    run_block(block, folder)
    return folder / _RECORDING


@pytest.mark.parametrize(
    "page",
    [pytest.param(page, marks=() if page.stem in _QUICK else pytest.mark.slow, id=page.stem) for page in _WITH_BLOCKS],
)
def test_blocks_run_in_order(page: Path, tmp_path: Path, request: pytest.FixtureRequest) -> None:
    set_up(tmp_path)
    if page != _GETTING_STARTED and any(_RECORDING.partition("/")[0] in block.text for block in blocks(page)):
        (tmp_path / _RECORDING).parent.mkdir()
        (tmp_path / _RECORDING).symlink_to(request.getfixturevalue("rendered"), target_is_directory=True)
    printed = "".join(run_block(block, tmp_path) for block in blocks(page))
    _LEFT_BEHIND.get(page.stem, lambda folder, text: None)(tmp_path, printed)


def _check_started(folder: Path, printed: str) -> None:
    assert "ATE" in printed
    assert (folder / "ate.png").is_file()
    assert {path.name for path in (folder / "results" / "room").iterdir()} >= FILES


def _check_cameras(folder: Path, printed: str) -> None:
    assert Camera.load(folder / "my_camera.yaml").depth_scale_per_m == 5000


def _check_calibration(folder: Path, printed: str) -> None:
    left = {path.name for path in (folder / "results" / "calibrated").iterdir()}
    assert left == {"camera.yaml", "calibration.json", "residuals.png"}
    assert Camera.load(folder / "results" / "calibrated" / "camera.yaml").depth_scale_per_m == 5000
    assert "unobservable" in printed


def _check_noise(folder: Path, printed: str) -> None:
    assert {path.name for path in (folder / "results" / "noise").iterdir()} == {"noise.yaml", "noise.json"}
    assert "track.depth_sigma_per_m2" in printed


def _check_networks(folder: Path, printed: str) -> None:
    assert [example.label for example in read_examples(folder / "examples.yaml")] == ["arm", "arm"]


def _check_dense(folder: Path, printed: str) -> None:
    assert all((folder / "results" / "dense" / name).is_file() for name in DENSE_FILES)


def _check_gradients(folder: Path, printed: str) -> None:
    gradient = [float(word) for word in printed.splitlines()[0].split()]
    assert len(gradient) == 2
    assert all(abs(value) > 0 for value in gradient)


def _check_benchmarks(folder: Path, printed: str) -> None:
    names = {path.name for path in (folder / "results" / "bench" / "my_suite").iterdir()}
    assert names >= {"report.html", "report.md", "results.json"}
    others = json.loads((folder / "results" / "bench" / "with_others" / "results.json").read_text())
    assert {run["label"]: run["status"] for run in others} == dict.fromkeys(("static", "my-slam", "their-slam"), "done")


def _check_worlds(folder: Path, printed: str) -> None:
    assert {path.name for path in (folder / "results" / "worlds" / "corridor").iterdir()} >= {"sheet.png", "clip.gif"}
    assert len(open_dataset(folder / "recordings" / "corridor")) == 15


_LEFT_BEHIND = {
    "getting-started": _check_started,
    "cameras-and-recordings": _check_cameras,
    "calibration": _check_calibration,
    "noise": _check_noise,
    "networks": _check_networks,
    "dense-map": _check_dense,
    "gradients-and-batches": _check_gradients,
    "benchmarks": _check_benchmarks,
    "worlds": _check_worlds,
}


def test_quick_pages_exist() -> None:
    assert {page.stem for page in _WITH_BLOCKS} >= _QUICK


@pytest.mark.parametrize("page", [README, CONTRIBUTING, *PAGES], ids=lambda page: f"{page.parent.name}-{page.stem}")
def test_links_lead_somewhere(page: Path) -> None:
    for link in links(page):
        if link.startswith("https://"):
            continue
        target, _, anchor = link.partition("#")
        other = (page.parent / target) if target else page
        assert other.exists(), link
        assert not anchor or anchor in anchors(other), link


@pytest.mark.parametrize("span", [span for span in dict.fromkeys(code_spans(CONTRIBUTING)) if _PATH.fullmatch(span)])
def test_path_in_contributing_exists(span: str) -> None:
    """A path starts at the root or in a package, or is a file's name alone; with NAME in it, its folder must exist."""
    path = Path(span)
    if "NAME" in path.name:
        path = path.parent
    alone = len(path.parts) == 1 and any((ROOT / "jaxslam").rglob(path.name))
    assert alone or any((ROOT / base / path).exists() for base in (".", "jaxslam", "kernels"))


def test_contributing_lists_every_package() -> None:
    """The table has the packages in the order of their layers, behind the kernels with all their chapters."""
    rows = dict(re.findall(r"^\| `([\w/]+)` \| (.*) \|$", prose(CONTRIBUTING), re.MULTILINE))
    kernels, *packages = rows
    assert packages == LAYERS
    chapters = {path.parent.name for path in (ROOT / kernels).glob("*/__init__.py")}
    assert set(re.findall(r"`(\w+)`", rows[kernels])) == chapters


@pytest.mark.parametrize("page", [README, CONTRIBUTING, *PAGES], ids=lambda page: f"{page.parent.name}-{page.stem}")
def test_spelling_is_american(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    for name in _OTHERS_NAMES:
        text = text.replace(name, "")
    assert not [word for word in _BRITISH.findall(text) if not _NOT_BRITISH.fullmatch(word)]


@pytest.mark.parametrize("page", [README, CONTRIBUTING, *PAGES], ids=lambda page: f"{page.parent.name}-{page.stem}")
def test_commands_in_the_text_exist(page: Path) -> None:
    """A command between backticks has the words of a command, and its options are options of that command."""
    for span in code_spans(page):
        words = span.split()
        if words[0] != "jaxslam" or len(words) == 1 or words[1].isupper() or words[1].startswith("--"):
            continue
        command = find_command(words[1:])
        assert command is not None, span
        named = {word[2:].replace("-", "_") for word in words if word.startswith("--")} - {"help"}
        if named:
            assert {name.removeprefix("no_") for name in named} <= {field.name for field in fields(command.options())}


@pytest.mark.parametrize("page", [README, *PAGES], ids=lambda page: f"{page.parent.name}-{page.stem}")
def test_settings_in_the_text_exist(page: Path) -> None:
    """A setting between backticks, such as `track.num_points=400`, is a field of `Config`."""
    for span in code_spans(page):
        for word in span.split():
            if (setting := _SETTING.match(word)) and not word.endswith(".png"):
                section: Any = Config()
                for name in setting[0].split("."):
                    assert is_dataclass(section), word
                    assert hasattr(section, name), word
                    section = getattr(section, name)


def test_index_lists_every_page() -> None:
    assert {target for target in links(DOCS / "README.md") if target.endswith(".md")} == {
        page.relative_to(DOCS).as_posix() for page in PAGES if page.name != "README.md"
    }


def test_every_result_file_is_listed() -> None:
    assert set(code_spans(_GETTING_STARTED)) >= FILES | MASK_FILES
    assert set(DENSE_FILES) <= set(code_spans(DOCS / "dense-map.md"))


def test_table_of_traced_and_static_settings_is_complete() -> None:
    rows = {row.split(",")[0]: row for row in prose(DOCS / "gradients-and-batches.md").splitlines()}
    named = lambda kind: re.findall(r"`(\w+)`", rows[kind].split("|")[2])
    assert named("| traced") == list(TrackParams._fields)
    assert named("| static") == list(TrackPlan._fields)


def test_table_of_statuses_is_complete() -> None:
    rows = re.findall(r"^\| `([A-Z]+)` \|", prose(DOCS / "robot-loop.md"), re.MULTILINE)
    assert sorted(rows) == sorted(status.name for status in TrackStatus)


def test_table_of_reasons_is_complete() -> None:
    text = prose(DOCS / "troubleshooting.md")
    assert [reason.text for reason in TrackReason if f"| {reason.text} |" not in text] == [""]


def test_table_of_presets_is_complete() -> None:
    assert set(presets()) <= set(code_spans(DOCS / "presets.md"))


def test_table_of_exit_codes_is_complete() -> None:
    rows = re.findall(r"^\| (\d+) \|", prose(DOCS / "command-line.md"), re.MULTILINE)
    assert rows == [str(int(code)) for code in ExitCode]


def test_generated_tables_are_up_to_date() -> None:
    spec = importlib.util.spec_from_file_location("make_tables", DOCS / "make_tables.py")
    assert spec is not None
    assert spec.loader is not None
    make_tables = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(make_tables)
    tables = make_tables.tables()
    for page in make_tables.PAGES:
        text = page.read_text(encoding="utf-8")
        assert make_tables.with_tables(text, tables) == text, f"{page}: run `python docs/make_tables.py`"
        assert "| --- |" in text
