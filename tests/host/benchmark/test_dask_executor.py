"""`jaxslam bench --executor dask://...`: a scheduler and workers on this machine, one of which does not live long."""

import json
import os
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest
from small_scene import SETTINGS

from jaxslam.cli.entry_point import main
from jaxslam.datasets.synthetic import SyntheticConfig, SyntheticDataset, write_tum
from jaxslam.errors import BenchmarkError

distributed = pytest.importorskip("distributed", reason="the extra `cluster` is not installed")
psutil = pytest.importorskip("psutil", reason="comes with distributed")

SUITE = f"""
about: a small room, rendered and recorded
presets: [static]
runs: 2
set: [semantics.model=null, {", ".join(SETTINGS)}]
sequences:
  - name: room
    room: {{frames: 8, people: 1, width: 160, height: 120}}
"""
RECORDINGS = "sequences:\n  - recording: recorded_room\n  - recording: room_nobody_has"
PATIENCE_S = 120.0


@dataclass
class Cluster:
    """Processes of Dask, which end with the test."""

    folder: Path
    ended: ExitStack = field(default_factory=ExitStack)

    def start(self, what: str, *options: str, **variables: str) -> "subprocess.Popen[bytes]":
        self.folder.mkdir(exist_ok=True)
        command = [sys.executable, "-m", f"distributed.cli.dask_{what}", "--dashboard-address", ":0", *options]
        with (self.folder / f"{what}.log").open("ab") as log:
            environment = {name: value for name, value in os.environ.items() if name != "JAXSLAM_DATA"} | variables
            process = subprocess.Popen(command, stdout=log, stderr=log, cwd=self.folder, env=environment)
        self.ended.callback(process.wait)
        self.ended.callback(process.kill)
        return process

    def scheduler(self, **variables: str) -> "subprocess.Popen[bytes]":
        return self.start(
            "scheduler", "--host", "127.0.0.1", "--port", "0", "--scheduler-file", "scheduler.json", **variables
        )

    def worker(self, host: str = "127.0.0.1", **variables: str) -> "subprocess.Popen[bytes]":
        one = ("--nthreads", "1", "--no-nanny", "--local-directory", "scratch")
        return self.start("worker", "--scheduler-file", "scheduler.json", "--host", host, *one, **variables)

    def executor(self, workers: int) -> str:
        """What `--executor` is told, when so many workers are there."""
        file = str(self.folder / "scheduler.json")
        wait_for(lambda: os.path.exists(file))
        with distributed.Client(scheduler_file=file, set_as_default=False, timeout=PATIENCE_S) as client:
            client.wait_for_workers(workers, timeout=PATIENCE_S)
            return client.scheduler.address.replace("tcp://", "dask://")


@pytest.fixture(scope="module")
def cluster(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cluster]:
    made = Cluster(tmp_path_factory.mktemp("cluster"))
    with made.ended:
        yield made


@pytest.fixture
def small_cluster(tmp_path: Path) -> Iterator[Cluster]:
    made = Cluster(tmp_path / "cluster")
    with made.ended:
        yield made


def wait_for(found: Callable[[], Any]) -> Any:
    """What a function gives, as soon as it gives something."""
    until = time.monotonic() + PATIENCE_S
    while time.monotonic() < until:
        value = found()
        if value:
            return value
        time.sleep(0.05)
    raise AssertionError(f"nothing found in {PATIENCE_S} s")


def job_of(worker: "subprocess.Popen[bytes]") -> Any:
    """The process of the job that a worker runs."""
    children = psutil.Process(worker.pid).children()
    return next((child for child in children if "jaxslam.benchmark.suites.job" in child.cmdline()), None)


def killed_at_work(process: "subprocess.Popen[bytes]", worker: "subprocess.Popen[bytes]") -> Any:
    """Kill a process as soon as a worker runs a job; gives that of the job."""
    job = wait_for(lambda: job_of(worker))
    process.kill()
    return job


def suite_file(folder: Path, text: str = SUITE) -> str:
    path = folder / "small.yaml"
    path.write_text(text)
    return str(path)


def results_in(out: Path) -> list[dict[str, Any]]:
    return json.loads((out / "results.json").read_text())


def files_in(out: Path) -> list[str]:
    return sorted(str(path.relative_to(out)) for path in out.rglob("*"))


def fails(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    with pytest.raises(SystemExit) as ended:
        main(["bench", *arguments])
    assert ended.value.code == 1
    return capsys.readouterr().err.strip().splitlines()[-1]


@dataclass(frozen=True)
class Outcome:
    """Of a suite during which a worker was killed."""

    suite: str
    out: Path
    data: Path
    job: Any
    executor: str


@pytest.fixture(scope="module")
def outcome(tmp_path_factory: pytest.TempPathFactory, cluster: Cluster) -> Outcome:
    """Of three workers on what look like two machines, one of the two with the recording is killed at work."""
    folder = tmp_path_factory.mktemp("bench")
    room = SyntheticDataset(SyntheticConfig(frames=8, people=1, width=160, height=120))
    write_tum(room, folder / "data" / "recorded_room")
    cluster.scheduler()
    cluster.worker("127.0.0.1")
    doomed, _ = (cluster.worker("127.0.0.2", JAXSLAM_DATA=str(folder / "data")) for _ in range(2))
    executor, suite = cluster.executor(workers=3), suite_file(folder, SUITE.replace("sequences:", RECORDINGS))
    with ThreadPoolExecutor(1) as killer, pytest.MonkeyPatch.context() as patch:
        patch.delenv("JAXSLAM_DATA", raising=False)  # this machine has no recordings
        job = killer.submit(killed_at_work, doomed, doomed)
        main(["bench", suite, "--out", str(folder / "out"), "--executor", executor])
        return Outcome(suite, folder / "out", folder / "data", job.result(), executor)


@pytest.mark.slow
class TestWorkerThatIsKilled:
    def test_nothing_is_lost(self, outcome: Outcome) -> None:
        runs = [(run["sequence"], run["seed"], run["status"]) for run in results_in(outcome.out)]
        assert runs == [(name, seed, "done") for name in ("recorded_room", "room") for seed in (0, 1)]
        for run in results_in(outcome.out):
            folder = outcome.out / run["sequence"] / run["label"] / str(run["seed"])
            assert json.loads((folder / "result.json").read_text()) == run

    def test_as_on_this_machine(self, outcome: Outcome, tmp_path: Path) -> None:
        """The same files, the same figures."""
        here = ["--out", str(tmp_path), "--root", str(outcome.data), "--workers", "2", "--runs", "1"]
        main(["bench", outcome.suite, *here])
        assert files_in(tmp_path) == [name for name in files_in(outcome.out) if "static/1" not in name]
        figures = ("sequence", "seed", "ate_rmse_m", "tracked_percent", "data_sha256")
        ours, theirs = ([[run[name] for name in figures] for run in results_in(out) if run["seed"] == 0]
                        for out in (tmp_path, outcome.out))  # fmt: skip
        assert ours == theirs
        assert all(0 < run["ate_rmse_m"] < 0.1 for run in results_in(tmp_path))

    def test_recordings_are_those_of_workers(self, outcome: Outcome) -> None:
        """Here is none; two workers had one, and were given its runs; nobody had the other."""
        hashes = {run["sequence"]: run["data_sha256"] for run in results_in(outcome.out)}
        assert hashes["room"] is None
        assert hashes["recorded_room"]
        assert "room_nobody_has: not there, nor in `jaxslam data list`" in (outcome.out / "report.md").read_text()

    def test_its_job_ends(self, outcome: Outcome) -> None:
        outcome.job.wait(PATIENCE_S)

    def test_nothing_is_left_there(self, outcome: Outcome, cluster: Cluster) -> None:
        assert (outcome.out / "report.html").is_file()
        kept = list((cluster.folder / "scratch").rglob("job.json"))
        assert len(kept) <= 1  # of the worker that was killed; Dask clears it when the next one begins

    def test_goes_on(self, outcome: Outcome, capsys: pytest.CaptureFixture[str]) -> None:
        """What is there is not run again."""
        files = sorted(outcome.out.rglob("result.json"))
        before = [path.stat().st_mtime_ns for path in files]
        main(["bench", outcome.suite, "--out", str(outcome.out), "--executor", outcome.executor, "--resume"])
        assert [path.stat().st_mtime_ns for path in files] == before
        assert "4 runs, 0 failed" in capsys.readouterr().out


def test_files_of_an_earlier_run_are_replaced(tmp_path: Path) -> None:
    from jaxslam.benchmark.suites.dask_executor import write_files  # noqa: PLC0415 - an extra

    write_files(tmp_path / "run", {"result.json": b"1", "masks.gif": b"1", "log.txt": b"1"})
    write_files(tmp_path / "run", {"result.json": b"2", "log.txt": b"2"})
    assert {path.name: path.read_bytes() for path in (tmp_path / "run").iterdir()} == {
        "result.json": b"2", "log.txt": b"2"
    }  # fmt: skip
    with pytest.raises(BenchmarkError, match=r"trajectory\.txt: cannot be written"):
        write_files(tmp_path / "run", {"result.json": b"3", "no_folder/trajectory.txt": b"3"})
    assert not (tmp_path / "run" / "result.json").exists()  # it would say that all are there


class TestTrouble:
    @staticmethod
    def run_and_kill(cluster: Cluster, folder: Path, whom: str, **variables: str) -> list[str]:
        """Arguments of a suite during which the scheduler or the only worker is killed, as a background task."""
        started = {"scheduler": cluster.scheduler(**variables), "worker": cluster.worker()}
        executor = cluster.executor(workers=1)
        cluster.ended.enter_context(killer := ThreadPoolExecutor(1))
        killer.submit(killed_at_work, started[whom], started["worker"])
        return [suite_file(folder), "--runs", "1", "--out", str(folder / "out"), "--executor", executor]

    @pytest.mark.slow
    def test_job_that_kills_its_workers(
        self, small_cluster: Cluster, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        """It is a row that says so, after as many workers as Dask allows: here one."""
        none = {"DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES": "0"}
        assert "1 of 1 runs failed" in fails(capsys, *self.run_and_kill(small_cluster, tmp_path, "worker", **none))
        (run,) = results_in(tmp_path / "out")
        assert run["status"] == "failed"
        assert run["problem"].startswith("workers that died while they had it: 1, last tcp://127.0.0.1:")
        assert run["problem"] in (tmp_path / "out" / "report.md").read_text()

    @pytest.mark.slow
    def test_scheduler_that_is_gone(
        self, small_cluster: Cluster, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        assert "scheduler is gone" in fails(capsys, *self.run_and_kill(small_cluster, tmp_path, "scheduler"))

    def test_nobody_there(
        self, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr("jaxslam.benchmark.suites.dask_executor._PATIENCE_S", 0.5)
        command = [suite_file(tmp_path), "--out", str(tmp_path / "out"), "--executor"]
        with closing(socket.create_server(("127.0.0.1", 0))) as silent:
            address = f"127.0.0.1:{silent.getsockname()[1]}"
            told = fails(capsys, *command, f"dask://{address}")  # it takes the call, and says nothing
            assert told.startswith(f"error: --executor: expected a Dask scheduler at {address}, none answers")
        assert "none answers: OSError: Timed out" in fails(capsys, *command, f"dask://{address}")
        assert not (tmp_path / "out").exists()

    def test_wrong_options(self, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
        suite = [suite_file(tmp_path), "--out", str(tmp_path / "out")]
        for wrong in ("dusk://host:8786", "dask://host", "dask://:8786", "dask://user@host:1", "8", "dask://host:1/x"):
            expected = f"error: --executor: expected local or dask://HOST:PORT, got '{wrong}'"
            assert fails(capsys, *suite, "--executor", wrong) == expected
        assert "--workers" in fails(capsys, *suite, "--executor", "dask://127.0.0.1:1", "--workers", "2")
        assert not (tmp_path / "out").exists()

    def test_without_dask(
        self, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.delitem(sys.modules, "jaxslam.benchmark.suites.dask_executor", raising=False)
        monkeypatch.setitem(sys.modules, "distributed", None)
        told = fails(capsys, suite_file(tmp_path), "--executor", "dask://127.0.0.1:1")
        assert "pip install 'jaxslam[cluster]'" in told
