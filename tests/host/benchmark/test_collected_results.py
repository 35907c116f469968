"""Results that are gone on with: what they depend on, what is kept of them, and what an interrupted call leaves."""

import json
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from made_results import done, not_done
from small_scene import clip
from tiny_recording import write_recording

from jaxslam.benchmark.reference_flow import flow_time_ms
from jaxslam.benchmark.reports.markdown import markdown_report
from jaxslam.benchmark.suites.collected_results import ALWAYS, Collected, read_results
from jaxslam.benchmark.suites.job import Job
from jaxslam.benchmark.suites.provenance import changes, identities
from jaxslam.benchmark.suites.suite import Sequence as Clip
from jaxslam.benchmark.suites.suite import Suite
from jaxslam.cli.entry_point import main
from jaxslam.errors import BenchmarkError, DatasetError
from jaxslam.sensors.frame import Frame

SUITE = """
presets: [static, default]
runs: 2
set: [semantics.model=null]
sequences:
  - name: room
    room: {frames: 8}
"""


def job(seed: int = 0, *, settings: tuple[str, ...] = ("semantics.model=null",)) -> Job:
    return Job(Clip("tiny", "tiny", camera="tum_fr1"), "static", "", settings, seed)


def test_results_with_earlier_names_are_read(tmp_path: Path) -> None:
    """Results written when the status was spelled RELOCALISED load, and have a row in the report."""
    earlier = done(status_counts={"OK": 926, "RELOCALISED": 1}, relocalised=1)
    (tmp_path / "results.json").write_text(json.dumps([earlier]))
    assert read_results(tmp_path) == [earlier]
    suite = Suite("crowd", "", (Clip("crowd", "crowd"),))
    assert "| static | 1 of 1 |" in markdown_report(suite, read_results(tmp_path), {})


class TestIdentity:
    def test_data_camera_and_networks(self, tmp_path: Path) -> None:
        folder = write_recording(tmp_path / "tiny", count=3)
        (tmp_path / "camera.yaml").write_text("a")
        of_file = replace(job(), clip=replace(job().clip, camera=str(tmp_path / "camera.yaml")))
        before = identities([job(), job(1), of_file], tmp_path)
        assert before[0] == before[1]
        assert before[0]["camera_sha256"] is None
        assert not changes(before[0], before[1])
        (folder / "rgb.txt").write_text((folder / "rgb.txt").read_text().rsplit("\n", 2)[0] + "\n")
        (tmp_path / "camera.yaml").write_text("b")
        (after,) = identities([of_file], tmp_path)
        assert changes(before[2], after) == [
            "the recording has changed, or is another one",
            "the camera file has changed",
        ]

    def test_networks(self, tmp_path: Path) -> None:
        network = tmp_path / "a.onnx"
        network.write_bytes(b"1")
        named = job(settings=(f"semantics.model={network}",))
        (before,) = identities([named], None)
        network.write_bytes(b"2")
        (other,) = identities([named], None)
        network.unlink()
        (nothing,) = identities([named], None)
        assert changes(before, other)[0].startswith("semantics.model: network was 6b86b273ff34, is d4735e3a265e")
        assert changes(before, nothing)
        missing = before | {"networks_sha256": {"model": None}}
        assert "network was not on the machine, is 6b86b273ff34" in changes(missing, before)[0]

    def test_versions_and_sources(self) -> None:
        """The sources decide; a result of an older jaxslam, which did not keep their hash, is another one."""
        now = {key: done()[key] for key in ("commit", "versions", "sources_sha256", "data_sha256", "camera_sha256")}
        now |= {"networks_sha256": {}}
        assert not changes(done(commit="other"), now)
        assert changes(done(sources_sha256="9", commit="def"), now) == ["jaxslam was def, is abc"]
        assert changes(done(sources_sha256="9"), now) == ["the sources of jaxslam abc changed"]
        assert changes(done(versions={"jaxslam": "0", "numpy": "1"}), now) == ["numpy was 1, is 2"]
        assert changes({"commit": "abc"}, now)


class TestCollected:
    def test_earlier_ones_stay(self, tmp_path: Path) -> None:
        """In their place; what is planned again is replaced, what is new comes after them."""
        earlier = [done("tiny", "default"), done("tiny", ate_rmse_m=0.5), not_done("failed", "killed", sequence="x")]
        collected = Collected([job(), job(1)], earlier)
        collected.add(done("tiny", seed=1))
        assert [(run["sequence"], run["label"], run["seed"], run["status"]) for run in collected.every] == [
            ("tiny", "default", 0, "done"),
            ("tiny", "static", 0, "not run"),
            ("x", "static", 0, "failed"),
            ("tiny", "static", 1, "done"),
        ]
        assert [(run["seed"], run["status"]) for run in collected.planned] == [(0, "not run"), (1, "done")]
        collected.write(tmp_path)
        read = read_results(tmp_path)
        assert len({tuple(run) for run in read}) == 1
        assert read[2]["frames"] is None
        assert read[2]["evaluation"] is None
        assert read[0] == {**dict.fromkeys(ALWAYS), **earlier[0]}

    def test_none_is_done(self, tmp_path: Path) -> None:
        Collected([job()]).write(tmp_path)
        (run,) = json.loads((tmp_path / "results.json").read_text())
        assert set(ALWAYS) <= set(run)

    @pytest.mark.parametrize("text", ["", "{", "[3]", '[{"sequence": "a"}]', "3"])
    def test_unreadable(self, tmp_path: Path, text: str) -> None:
        assert read_results(tmp_path) == []
        (tmp_path / "results.json").write_text(text)
        with pytest.raises(BenchmarkError, match=r"results\.json: expected the results of a suite"):
            read_results(tmp_path)


@dataclass(frozen=True)
class Broken:
    """Runs one job, and is then interrupted."""

    problem: BaseException
    recordings: tuple[str, ...] = ()

    def identities(self, jobs: Sequence[Job]) -> list[dict[str, Any]]:
        return identities(jobs, None)

    def run(self, jobs: Sequence[Job], out: Path) -> Iterator[tuple[Job, dict[str, Any]]]:
        yield jobs[0], done(jobs[0].clip.name, jobs[0].label, jobs[0].seed)
        raise self.problem


@pytest.mark.parametrize("problem", [KeyboardInterrupt(), BenchmarkError("nobody is there")], ids=["ctrl-c", "error"])
def test_broken_off(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], problem: BaseException
) -> None:
    """All reports are there, of what is done."""

    @contextmanager
    def broken(workers: int, root: Path | None) -> Iterator[Broken]:
        yield Broken(problem)

    monkeypatch.setattr("jaxslam.cli.suite_run.local", broken)
    (tmp_path / "suite.yaml").write_text(SUITE)
    with pytest.raises(SystemExit):
        main(
            [
                "bench",
                str(tmp_path / "suite.yaml"),
                "--out",
                str(tmp_path / "out"),
                "--sweep",
                "dynamics.cues=[clusters],[]",
            ]
        )
    statuses = [run["status"] for run in json.loads((tmp_path / "out" / "results.json").read_text())]
    assert statuses == ["done"] + ["not run"] * 7
    for report in ("report.md", "report.html"):
        assert "1 of 8 planned runs are done, 7 not made yet" in (tmp_path / "out" / report).read_text()
    out = capsys.readouterr().out
    assert "1 runs, 0 failed, 7 not made" in out
    assert "room, static@cues=[clusters], seed 0: ATE 0.0200 m" in out  # brackets are no markup


class TestFlowTime:
    """Of OpenCV's flow, the unit of times."""

    class Holes:
        """A recording some of whose frames cannot be read."""

        def __init__(self, broken: set[int]) -> None:
            self.whole, self.broken = clip(frames=20), broken
            self.name, self.camera = "holes", self.whole.camera
            self.timestamps_ns, self.ground_truth = self.whole.timestamps_ns, None

        def __len__(self) -> int:
            return len(self.whole)

        def __getitem__(self, index: int) -> Frame:
            if index in self.broken:
                raise DatasetError(f"frame {index}: cannot be decoded")
            return self.whole[index]

    @pytest.mark.parametrize("broken", [set(), {0}, set(range(5, 15)), set(range(18))])
    def test_frames_that_cannot_be_read_are_passed_over(self, broken: set[int]) -> None:
        found = flow_time_ms(self.Holes(broken))
        assert found is not None
        assert 0 < found < np.inf

    def test_none_without_a_pair(self) -> None:
        assert flow_time_ms(self.Holes(set(range(0, 20, 2)))) is None
