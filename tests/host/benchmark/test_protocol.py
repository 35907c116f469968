"""Protocols of papers: what they set in a suite, and the tables that they make of its runs."""

from pathlib import Path
from typing import Any

import pytest
from made_results import done, not_done

from jaxslam.benchmark.reports.markdown import markdown_report, protocol_table
from jaxslam.benchmark.suites.aggregate import rows_of
from jaxslam.benchmark.suites.plan import plan
from jaxslam.benchmark.suites.protocol import Protocol, load_protocol, protocols
from jaxslam.benchmark.suites.suite import Suite, load_suite
from jaxslam.errors import BenchmarkError

SEQUENCES = "presets: [static]\nsequences: [{recording: rgbd_bonn_crowd, name: crowd}]\n"
TRIMMED = Protocol("mean without extremes", ("ate_rmse_m", "rpe_trans_std_m_per_s"), "trimmed_mean")


def loaded(folder: Path, text: str) -> Suite:
    (folder / "mine.yaml").write_text(SEQUENCES + text)
    return load_suite(str(folder / "mine.yaml"))


def runs(ates: list[float], **changes: Any) -> list[dict[str, Any]]:
    return [
        done(seed=seed, ate_rmse_m=ate, evaluation={"rpe_trans_std_m_per_s": 10 * ate}, **changes)
        for seed, ate in enumerate(ates)
    ]


class TestSuite:
    @pytest.mark.parametrize("name", protocols())
    def test_that_comes_with_jaxslam(self, name: str) -> None:
        assert load_protocol(name, "here").about.endswith(".")

    def test_gives_runs(self, tmp_path: Path) -> None:
        """Unless the suite or the command line does."""
        assert len(plan(loaded(tmp_path, "protocol: rts"))) == 20
        assert len(plan(loaded(tmp_path, "protocol: rts"), runs=2)) == 2
        assert len(plan(loaded(tmp_path, "protocol: rts\nruns: 4"))) == 4
        assert loaded(tmp_path, "protocol: usd").runs == 1

    def test_gives_variants(self, tmp_path: Path) -> None:
        """All frames, and late ones dropped."""
        jobs = plan(loaded(tmp_path, "protocol: ngd"))
        assert {job.variant: job.config.run.realtime for job in jobs} == {"all-frames": False, "real-time": True}
        with pytest.raises(BenchmarkError, match=r"expected none beside those of the protocol \(all-frames, r"):
            loaded(tmp_path, "protocol: ngd\nvariants: {a: [track.num_points=256]}")

    def test_tables_of_papers(self) -> None:
        rts, ngd, usd = (load_suite(f"{name}_tables") for name in ("rts", "ngd", "usd"))
        assert (rts.runs, len(rts.sequences)) == (20, 5)
        assert len(ngd.sequences) == 4 + 9
        assert [clip.recording for clip in usd.sequences] == [f"kitti_{number:02d}" for number in range(1, 11)]

    @pytest.mark.parametrize(
        ("text", "message"),
        [
            ("protocol: rst", "protocol: unknown protocol 'rst' .did you mean 'rts'"),
            ("protocol: {about: x, columns: []}", "columns: expected at least one figure"),
            ("protocol: {about: x, columns: [ate_rms_m]}", "unknown figure 'ate_rms_m' .did you mean 'ate_rmse_m'"),
            ("protocol: {about: x}", "columns"),
            ("protocol: {about: x, columns: [ate_rmse_m], statistic: best}", "statistic: expected one of 'median'"),
            (
                "protocol: {about: x, columns: [ate_rmse_m], statistic: trimmed_mean, runs: 2}",
                "runs: expected 3 or more for a trimmed_mean, got 2",
            ),
        ],
    )
    def test_wrong(self, tmp_path: Path, text: str, message: str) -> None:
        with pytest.raises(BenchmarkError, match=message):
            loaded(tmp_path, text)


class TestTable:
    def test_mean_without_the_best_and_the_worst(self) -> None:
        """Of each figure, whatever the order of the runs."""
        head, line = protocol_table(TRIMMED, rows_of(runs([0.9, 0.01, 0.02, 0.001, 0.06])))
        assert head == ["sequence", "preset", "runs", "ATE, m", "RPE S.D., m/s"]
        assert line == ["crowd", "static", "5 of 5", "0.0300", "0.3000"]

    @pytest.mark.parametrize(
        ("statistic", "ate"), [("median", "0.0200"), ("mean", "0.0300"), ("trimmed_mean", "0.0200")]
    )
    def test_statistics(self, statistic: Any, ate: str) -> None:
        (_, line) = protocol_table(Protocol("", ("ate_rmse_m",), statistic), rows_of(runs([0.01, 0.06, 0.02])))
        assert line[3] == ate

    def test_too_few_runs(self) -> None:
        (_, line) = protocol_table(TRIMMED, rows_of([*runs([0.01, 0.02]), not_done("failed", "killed", seed=2)]))
        assert line == ["crowd", "static", "2 of 3", "-", "-"]

    def test_mean_of_the_sequences(self) -> None:
        """Of a label that has the figure of every one."""
        results = [*runs([0.01] * 3), *runs([0.03] * 3, sequence="other")]
        results += [*runs([0.02] * 3, label="ngd"), not_done("failed", "x", sequence="other", label="ngd")]
        *_, static, ngd = protocol_table(TRIMMED, rows_of(results))
        assert static == ["mean of the sequences", "static", "", "0.0200", "0.2000"]
        assert ngd == ["mean of the sequences", "ngd", "", "-", "-"]

    def test_report(self, tmp_path: Path) -> None:
        suite = loaded(tmp_path, "protocol: {about: as in the paper, columns: [ate_std_m], statistic: mean}")
        text = markdown_report(suite, [done(evaluation={"ate_std_m": 0.0123})], {})
        assert "## Table of the paper\n\nas in the paper\n\n| sequence | preset | runs | ATE S.D., m |" in text
        assert "| crowd | static | 1 of 1 | 0.0123 |" in text
