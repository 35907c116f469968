"""Protocols of papers: what they set in a suite, and the tables that they make of its runs."""

import re
from pathlib import Path
from typing import Any

import pytest
import yaml
from doc_blocks import DOCS
from made_results import done, not_done
from small_scene import HEIGHT, SETTINGS, WIDTH

from jaxslam.benchmark.reports.markdown import markdown_report, paper_table, protocol_table
from jaxslam.benchmark.suites.aggregate import rows_of
from jaxslam.benchmark.suites.plan import plan
from jaxslam.benchmark.suites.protocol import Protocol, load_protocol, protocols
from jaxslam.benchmark.suites.suite import Suite, load_suite
from jaxslam.cli.entry_point import main
from jaxslam.config.loading import configs_dir
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
        assert (rts.runs, len(rts.sequences)) == (20, 5 + 9)
        assert len(ngd.sequences) == 4 + 9
        assert [clip.recording for clip in usd.sequences] == [f"kitti_{number:02d}" for number in range(1, 11)]

    @pytest.mark.parametrize(
        ("text", "message"),
        [
            ("protocol: ngdd", "protocol: unknown protocol 'ngdd' .did you mean 'ngd'"),
            ("protocol: {about: x, columns: []}", "columns: expected at least one figure"),
            ("protocol: {about: x, columns: [ate_rms_m]}", "unknown figure 'ate_rms_m' .did you mean 'ate_rmse_m'"),
            ("protocol: {about: x}", "columns"),
            ("protocol: {about: x, columns: [ate_rmse_m], statistic: best}", "statistic: expected one of 'median'"),
            (
                "protocol: {about: x, columns: [ate_rmse_m], statistic: trimmed_mean, runs: 2}",
                "runs: expected 3 or more for a trimmed_mean, got 2",
            ),
            (
                "protocol: {about: x, columns: [ate_rmse_m], tables: [{title: t, paper: NGD, columns: []}]}",
                "paper: unknown paper 'NGD'",
            ),
            (
                "protocol: {about: x, columns: [ate_rmse_m], tables: [{title: t, paper: NGD-SLAM,"
                " columns: [track_ms_mean], published: {NGD-SLAM: [frame_msec]}}]}",
                "published: NGD-SLAM: unknown figure 'frame_msec' .did you mean 'frame_ms'",
            ),
            (
                "protocol: {about: x, columns: [ate_rmse_m], tables: [{title: t, paper: NGD-SLAM,"
                " columns: [track_ms_mean], published: {NGD-SLAM: [frame_ms, frame_ms]}}]}",
                "published: NGD-SLAM: expected 1 figures, got 2",
            ),
            (
                "protocol: {about: x, columns: [ate_rmse_m], tables: [{title: t, paper: NGD-SLAM, columns: [flow]}]}",
                "unknown figure 'flow'",
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


def times(**mean_ms: float) -> dict[str, dict[str, float]]:
    return {stage.replace("_", " "): {"mean": ms} for stage, ms in mean_ms.items()}


class TestPaperTables:
    """Tables of times and sizes, with the figures of the paper above ours."""

    def test_keyframes_of_ngd(self) -> None:
        protocol = load_protocol("ngd", "here")
        result = done(
            label="ngd",
            track_ms={"mean": 7.0},
            keyframe_ms={"mean": 21.0},
            keyframe_stage_ms=times(masks=3.0, flow=2.0, match_with_map=5.5),
            stage_ms=times(masks=1.0, flow=1.5),
        )
        head, paper, ours = paper_table(protocol, protocol.tables[0], rows_of([result]))
        assert head[:4] == ["Table IV: keyframes", "of", "masks, ms a keyframe", "flow, ms a keyframe"]
        assert paper == ["NGD-SLAM", "paper of NGD-SLAM", "7.92", "3.04", "19.73", "30.69", "16.72"]
        assert ours == ["ngd", "crowd", "3.00", "2.00", "5.50", "21.00", "7.0"]

    def test_modules_of_trs(self) -> None:
        """The published figures of other systems too; `-` where there is none."""
        protocol = load_protocol("trs", "here")
        result = done(label="trs", track_ms={"mean": 9.0}, stage_ms=times(detector=12.25, pose=4.0))
        lines = paper_table(protocol, protocol.tables[0], rows_of([result]))
        assert ["DynaSLAM", "paper of TRS-SLAM", "-", "-", "1144.93"] in lines
        assert lines[-1] == ["trs", "crowd", "12.25", "4.00", "9.0"]

    def test_dense_map_of_rts(self, tmp_path: Path) -> None:
        dense = {"points": 250, "megabytes": 0.004, "measured_points": 1000, "ms_per_keyframe": {"mean": 1.26}}
        cells = {"side_m": 0.05, "occupied": 20, "free": 30}
        suite = loaded(tmp_path, "protocol: rts-dense")
        text = markdown_report(suite, [done(dense=dense | {"cells": cells})], {})
        assert "| Table 9: dense map | of | points | MB | ms a keyframe |" in text
        assert "| all points | paper of RTS-SLAM | 1569892 | 120 | 41 |" in text
        assert "| static | crowd | 250 | 0.00 | 1.3 |" in text.replace("1.26", "1.3")
        octree = load_protocol("usd-dense", "here")
        (_, line) = protocol_table(octree, rows_of([done(dense=dense | {"cells": cells})]))
        assert line[3:9] == ["250", "0.00", "1.26", "20", "30", "0.050"]

    def test_runs_without_them(self) -> None:
        """Older results, and those of other systems, have no times of stages."""
        protocol = load_protocol("ngd", "here")
        assert paper_table(protocol, protocol.tables[0], rows_of([done()]))[-1][2:] == ["-"] * 5


SUITES_OF_PAGES = {
    name: page.stem
    for page in sorted((DOCS / "systems").glob("*.md"))
    for name in re.findall(r"`jaxslam bench (\w+_\w+)`", page.read_text(encoding="utf-8"))
}


class TestCommandsOfPages:
    @pytest.mark.parametrize("name", SUITES_OF_PAGES)
    def test_suite_exists(self, name: str) -> None:
        assert load_suite(name).sequences

    @pytest.mark.slow
    @pytest.mark.parametrize("name", SUITES_OF_PAGES)
    def test_runs_on_small_input(self, tmp_path: Path, name: str) -> None:
        """The suite as it is, on eight frames of a small room, with the first of its presets."""
        suite = yaml.safe_load((configs_dir() / "benchmarks" / f"{name}.yaml").read_text())
        room = {"width": WIDTH, "height": HEIGHT, "frames": 8, "people": 1}
        suite |= {"sequences": [{"name": "small", "room": room}], "runs": 1, "presets": suite["presets"][:1]}
        suite["set"] = ["semantics.model=null", *SETTINGS]
        (tmp_path / "small.yaml").write_text(yaml.safe_dump(suite))
        main(["bench", str(tmp_path / "small.yaml"), "--runs", "1", "--out", str(tmp_path / "out")])
        text = (tmp_path / "out" / "report.md").read_text()
        protocol = load_suite(str(tmp_path / "small.yaml")).protocol
        assert "failed" not in text
        for number, table in enumerate(() if protocol is None else protocol.tables, 1):
            last = [line for line in text.split(f"| {table.title} |")[1].splitlines() if line.startswith("|")]
            assert last
            assert all((tmp_path / "out" / "tables" / f"paper-{number}{end}").is_file() for end in (".csv", ".tex"))
