"""`jaxslam bench kernels`: rows that are what they say, the same results on both sides, other libraries missing."""

import contextlib
import importlib.metadata
import io
import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
from command_line import failing
from PIL import Image
from quick_compile import quick_compile

from jaxslam.benchmark.kernels import case as case_module
from jaxslam.benchmark.kernels.measure import devices, measure
from jaxslam.benchmark.kernels.registry import CASES, chosen
from jaxslam.benchmark.kernels.report import cells, markdown_report, picture, slopes
from jaxslam.benchmark.kernels.scenes.two_views import make_two_views
from jaxslam.benchmark.timing import call_times, compare, pinned_to_one_core
from jaxslam.cli.entry_point import main
from jaxslam.runtime.machine import machine

fails = failing("bench", "kernels")

PRINTED = "printed.json"
MEASURED, ROUNDS = ("image_pyramid", "lk_flow", "dbscan"), 6
SMALL = (
    "corners", "pose_refine", "bundle_adjust", "pose_graph", "alignment", "cue_clusters", "cue_epipolar_trajectory",
    "cue_occlusion",
)  # fmt: skip
"""What else is compared here, once and at its smallest size."""


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What the command leaves behind; what it prints is in a file beside this folder."""
    folder = tmp_path_factory.mktemp("kernels") / "out"
    options = ["--quick", "--rounds", str(ROUNDS), "--only", *MEASURED, "--out", str(folder), "--json"]
    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(io.StringIO()) as printed:
        patch.setenv("NPROC", "1")  # as the command does, but undone
        main(["bench", "kernels", *options])
    (folder.parent / PRINTED).write_text(printed.getvalue())
    return folder


@pytest.fixture(scope="module")
def content(out: Path) -> dict[str, Any]:
    return json.loads((out / "kernels.json").read_text())


@pytest.mark.slow
class TestResults:
    def test_are_printed_alone(self, out: Path, content: dict[str, Any]) -> None:
        assert json.loads((out.parent / PRINTED).read_text()) == content

    def test_of_every_size(self, content: dict[str, Any]) -> None:
        assert [(row["kernel"], row["size"]) for row in content["rows"] if row["backend"] == "cpu"] == [
            (case.name, size) for case in chosen(MEASURED) for size in case.sizes[:2]
        ]
        assert list(content["kernels"]) == list(MEASURED)
        assert {"cpu", "cores", "threads", "versions", "commit", "rounds", "quick"} <= set(content)
        assert content["versions"]["scipy"] == importlib.metadata.version("scipy")

    def test_figures_follow_from_times(self, content: dict[str, Any]) -> None:
        for row in content["rows"]:
            ours, theirs = row["ours_times_ms"], row["theirs_times_ms"]
            assert len(ours) == len(theirs) == ROUNDS
            assert min(*ours, *theirs, row["compile_s"]) > 0
            assert row["ours_ms"] == np.median(ours)
            assert row["theirs_ms"] == np.median(theirs)
            assert row["ratio"] == pytest.approx(row["ours_ms"] / row["theirs_ms"], rel=1e-12)
            assert row["ours_p95_ms"] == np.percentile(ours, 95)
            assert row["ours_min_ms"] == min(ours)

    def test_both_sides_did_the_same(self, content: dict[str, Any]) -> None:
        for row in content["rows"]:
            assert row["difference"] <= CASES[row["kernel"]].limit
            assert row["agrees"]
            assert row["problem"] is None

    def test_table_and_picture(self, out: Path, content: dict[str, Any]) -> None:
        text = (out / "kernels.md").read_text()
        _, _, *lines = [line.strip("| ").split(" | ") for line in text.splitlines() if line.startswith("|")]
        assert lines == [cells(row) for row in content["rows"]]
        for name, kernel in content["kernels"].items():
            assert f"`{name}` beside {kernel['reference']}: {kernel['compared']}" in text
        with Image.open(out / "kernels.png") as image:
            assert image.width > 1000
            assert len(np.unique(np.asarray(image).reshape(-1, 4), axis=0)) > 10


@pytest.mark.slow
@pytest.mark.parametrize("name", SMALL)
def test_results_agree(name: str) -> None:
    """And would not, were ours another."""
    case = CASES[name]
    if (absent := case.missing()) is not None:
        pytest.skip(f"{absent} is not installed")
    problem = case.problem(case.sizes[0])
    program = quick_compile(problem.ours) if problem.compile is None else problem.ours
    ours, theirs = program(*problem.arguments), problem.theirs(*problem.prepare())
    assert problem.difference(ours, theirs) <= case.limit
    other = jax.tree.map(lambda x: 1.1 * x + 1 if np.issubdtype(x.dtype, np.floating) else x, ours)
    assert problem.difference(other, theirs) > case.limit


def test_fundamental_matrices_are_told_apart() -> None:
    """The true one has as many right matches as OpenCV's, another one has not; ours is compiled for a cue above."""
    case = CASES["ransac_fundamental"]
    problem = case.problem(case.sizes[0])
    theirs, truth = problem.theirs(), make_two_views(0, case.sizes[0]).F
    assert problem.difference(truth, theirs) <= case.limit
    assert problem.difference(1.1 * truth + 1, theirs) > case.limit
    assert problem.difference(theirs[0], theirs) == 0
    assert problem.difference(truth, (None, None)) == np.inf


def test_what_works_on_the_host_is_called_as_it_is() -> None:
    row = measure(CASES["cue_occlusion"], CASES["cue_occlusion"].sizes[0], devices()[0], ROUNDS)
    assert row["agrees"]
    assert min(row["compile_s"], *row["ours_times_ms"]) > 0
    assert len(row["ours_times_ms"]) == ROUNDS


class TestWithoutReference:
    @pytest.fixture
    def row(self, monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
        def version(name: str) -> str:
            if name == "scikit-learn":
                raise importlib.metadata.PackageNotFoundError(name)
            return importlib.metadata.version(name)

        monkeypatch.setattr(case_module, "version", version)
        return measure(CASES["dbscan"], 32, devices()[0], ROUNDS)

    def test_row_says_so(self, row: dict[str, Any]) -> None:
        assert row["problem"] == "scikit-learn is not installed"
        assert row["ours_ms"] == np.median(row["ours_times_ms"])
        assert len(row["ours_times_ms"]) == ROUNDS
        assert {row[name] for name in ("theirs_ms", "theirs_times_ms", "ratio", "difference", "agrees")} == {None}

    def test_is_in_the_report(self, row: dict[str, Any]) -> None:
        text = markdown_report([CASES["dbscan"]], [row], machine())
        assert f"| dbscan | 32 | cpu | {cells(row)[3]} | {cells(row)[4]} | - | - | - | - |" in text
        assert "beside sklearn.cluster.DBSCAN (scikit-learn is not installed): " in text
        assert picture([CASES["dbscan"]], [row]).startswith(b"\x89PNG")


def made(backend: str, size: int, ours_ms: float, theirs_ms: float) -> dict[str, Any]:
    return {
        "kernel": "dbscan", "size": size, "label": str(size), "backend": backend, "device": backend, "compile_s": 1.0,
        "ours_ms": ours_ms, "ours_p95_ms": ours_ms, "theirs_ms": theirs_ms, "theirs_p95_ms": theirs_ms,
        "ratio": ours_ms / theirs_ms, "difference": 0.5, "agrees": False, "problem": None,
    }  # fmt: skip


class TestReport:
    ROWS = tuple(
        made(backend, size, factor * size**1.5, 3 * size**0.5)
        for size in (10, 100, 1000)
        for backend, factor in (("cpu", 2.0), ("gpu", 0.1))
    )

    def test_slopes(self) -> None:
        assert slopes(self.ROWS) == pytest.approx({"ours cpu": 1.5, "theirs": 0.5, "ours gpu": 1.5})
        assert slopes(self.ROWS[:1]) == {}

    def test_another_device(self) -> None:
        text = markdown_report([CASES["dbscan"]], self.ROWS, machine())
        assert "| dbscan | 10 | gpu | 3.16 | 3.16 | 9.49 | 9.49 | 0.333 | 0.5, too much | 1.0 |" in text
        assert "Accelerator: gpu." in text
        image = np.asarray(Image.open(io.BytesIO(picture([CASES["dbscan"]], self.ROWS))).convert("RGB"))
        for color in ((0x00, 0x72, 0xB2), (0x00, 0x9E, 0x73), (0xD5, 0x5E, 0x00)):
            assert (image == color).all(axis=2).any()

    def test_nothing_found(self) -> None:
        assert "one found nothing" in cells(self.ROWS[0] | {"difference": None})


class TestTiming:
    def test_slow_rounds_are_few(self) -> None:
        assert len(call_times(lambda: None, rounds=100, warm_up=0, most_s=0.0)) == 5
        assert len(call_times(lambda: None, rounds=3, warm_up=0, most_s=0.0)) == 3

    def test_problem_is_made_anew(self) -> None:
        problems: list[list[int]] = []

        def prepare() -> tuple[list[int]]:
            problems.append([])
            return (problems[-1],)

        solve: Callable[[list[int]], None] = lambda problem: problem.append(1)
        comparison = compare(lambda: None, solve, rounds=4, warm_up=2, prepare=prepare)
        assert problems == [[1]] * 6
        assert comparison.ours_ms.shape == comparison.theirs_processor_ms.shape == (4,)

    @pytest.mark.skipif(not hasattr(os, "sched_getaffinity"), reason="threads cannot be held here")
    def test_cores_are_given_back(self) -> None:
        before = os.sched_getaffinity(0)
        with pinned_to_one_core():
            assert len(os.sched_getaffinity(0)) == 1
        assert os.sched_getaffinity(0) == before


class TestBadInput:
    def test_unknown_kernel(self, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
        error = fails(capsys, "--only", "lkflow", "--out", str(tmp_path / "out"))
        assert error == "--only: unknown kernel 'lkflow' (did you mean 'lk_flow'?)"
        assert not (tmp_path / "out").exists()

    def test_no_rounds(self, capsys: pytest.CaptureFixture[str]) -> None:
        assert fails(capsys, "--rounds", "0") == "--rounds: expected at least 1, got 0"

    def test_no_folder(self, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
        (tmp_path / "file").write_text("")
        for out in (tmp_path / "file", tmp_path / "file" / "out"):
            assert fails(capsys, "--out", str(out)).startswith(f"--out: '{out}' cannot be written to: ")
