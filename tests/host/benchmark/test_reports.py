"""What a benchmark's report says of results, beside published figures: made by hand, nothing is run."""

from pathlib import Path
from typing import Any

import pytest
from made_results import done, not_done

from jaxslam.benchmark.reports.document import Bullets, Heading, Image, Paragraph, Table, to_html, to_markdown
from jaxslam.benchmark.reports.html import html_report
from jaxslam.benchmark.reports.markdown import (
    markdown_report,
    overview_table,
    suite_report,
    summary_lines,
    warnings,
    without_network,
)
from jaxslam.benchmark.reports.plots import plot_spread
from jaxslam.benchmark.reports.published_tables import (
    comparison_table,
    described,
    protocols,
    published_table,
    published_tables,
    rank_table,
)
from jaxslam.benchmark.reports.table_files import to_csv, to_latex, write_tables
from jaxslam.benchmark.suites.aggregate import rows_of
from jaxslam.benchmark.suites.protocol import Protocol
from jaxslam.benchmark.suites.published import Figure, load_published, published_for
from jaxslam.benchmark.suites.published_comparison import (
    METRICS,
    NO_VERDICT,
    best_of_systems,
    kitti_means,
    published_of,
    reservations,
)
from jaxslam.benchmark.suites.suite import Sequence, Suite
from jaxslam.datasets.synthetic import SyntheticConfig
from jaxslam.visualization.plots import png

CROWD = Suite("any", "", (Sequence("crowd", "rgbd_bonn_crowd"), Sequence("mine", "my_own_recording")))
W = "rgbd_dataset_freiburg3_walking_xyz"
TUM = Suite("tum", "", (Sequence("w", W),))
MARKER = "another body, so the RPE says nothing"


def of_w(**changes: Any) -> dict[str, Any]:
    """A run of all of walking_xyz, with as many frames as have depth."""
    evaluation = {"num_matched": 827} | changes.pop("evaluation", {})
    return done("w", frames=827, images=859, tracked=827, evaluation=evaluation, **changes)


def kitti(number: int, frames: int, **changes: Any) -> dict[str, Any]:
    figures = {"kitti_trans_percent": 0.7 + number / 100, "kitti_rot_deg_per_100m": 0.2, "num_matched": frames}
    made = {"frames": frames, "images": frames, "tracked": frames, "ate_rmse_m": 2.0} | changes
    return done(f"kitti_{number:02d}", evaluation=figures, **made)


KITTI_FRAMES = (4541, 1101, 4661, 801, 271, 2761, 1101, 1101, 4071, 1591, 1201)
KITTI = Suite("kitti", "", tuple(Sequence(f"kitti_{n:02d}", f"kitti_{n:02d}") for n in range(11)))


class TestReservations:
    """Why figures may not be compared."""

    @pytest.mark.parametrize(
        ("runs", "reason"),
        [
            ([done(), done(seed=1)], None),
            ([done(), not_done("failed", "killed", seed=1)], "1 of 2 planned runs are done"),
            ([done(), not_done("not run", seed=1)], "1 of 2 planned runs are done"),
            ([done(), done(seed=1, tracked=870, tracked_percent=93.9)], "93.9 % of the frames tracked"),
            (
                [done(tracked=870), not_done("failed", "killed", seed=1)],
                "1 of 2 planned runs are done; 93.9 % of the frames tracked",
            ),
            ([done(tracked=464, dropped=463, dropped_percent=49.9)], "50.1 % of the frames tracked, 49.9 % dropped"),
            (
                [done(frames=30, images=30, tracked=30, evaluation={"num_matched": 30})],
                "a part of the recording: 30 of 928 images",
            ),
            (
                [done(frames=400, tracked=400, evaluation={"num_matched": 400})],
                "400 frames of 928 images",
            ),
            ([done(evaluation={"num_matched": 460})], "49.6 % of the frames matched with ground truth"),
            ([done(), done(seed=1, ate_rmse_m=None, evaluation=None)], "1 of 2 runs have no ATE"),
            ([done(evaluation={"span_percent": 30.0})], None),  # its length is known
            ([done(evaluation={"span_percent": None})], None),
        ],
        ids=["all", "failed", "left", "lost", "both", "late", "part", "no-depth", "truth", "no-ate", "known", "-"],
    )
    def test_of_a_row(self, runs: list[dict[str, Any]], reason: str | None) -> None:
        (row,) = rows_of(runs)
        assert "; ".join(reservations(CROWD, row)) == (reason or "")
        ate = published_tables(CROWD, "crowd", [row])["ate_rmse_m"]
        verdicts = {line[2] for line in ate[1:] if line[0] != "static"}
        assert (verdicts == {NO_VERDICT}) == (reason is not None)
        best = f"1 {NO_VERDICT.replace('no ', 'without a ')}"
        assert (best in summary_lines(CROWD, [row])[0]) == (reason is not None)
        assert overview_table(CROWD, [row])[1][1] == ("0.0200" if reason is None else "0.0200*")
        said = [line for line in warnings(CROWD, runs) if line.startswith("no verdict")]
        assert said == ([] if reason is None else [f"no verdict for crowd (static): {reason}"])

    def test_part_of_kitti(self) -> None:
        (row,) = rows_of([kitti(6, 51)])
        assert reservations(KITTI, row) == ["a part of the recording: 51 of 1101 images"]

    def test_images_without_depth(self) -> None:
        """All of TUM walking_xyz; some images have no depth at the same time."""
        (row,) = rows_of([of_w()])
        assert not reservations(TUM, row)

    @pytest.mark.parametrize(("covered", "said"), [(95.0, []), (12.0, ["frames cover 12.0 % of the time"])])
    def test_length_that_is_not_known(self, covered: float, said: list[str]) -> None:
        """Ground truth decides, and the report says that nothing better is known."""
        suite = Suite("any", "", (Sequence("b", "rgbd_bonn_balloon"),))
        runs = [done("b", evaluation={"span_percent": covered})]
        found = reservations(suite, *rows_of(runs))
        assert [text in reason for text, reason in zip(said, found, strict=True)] == [True] * len(said)
        assert any("the published length is not known" in line for line in warnings(suite, runs))
        unevaluated = [done("b", ate_rmse_m=None, evaluation=None, evaluation_problem="no ground truth")]
        assert warnings(suite, unevaluated) == ["no ATE of b (static, 1 of 1 runs): no ground truth"]

    def test_nothing_of_the_sort_where_nothing_is_published(self) -> None:
        runs = [done("mine", frames=3, images=3, tracked=3, evaluation={"num_matched": 3})]
        assert not warnings(CROWD, runs)
        room = Suite("r", "", (Sequence("room", room=SyntheticConfig(frames=5)),))
        assert not warnings(room, [done("room")])


class TestPublished:
    """Figures of papers beside ours."""

    @staticmethod
    def lines(clip: Sequence, ates: tuple[float, float]) -> list[list[str]]:
        runs = [done(clip.name, "ours", seed, ate_rmse_m=ate) for seed, ate in enumerate(ates)]
        return published_table(Suite("any", "", (clip,)), clip.name, rows_of(runs))

    def test_beside_ours(self) -> None:
        head, *lines = self.lines(Sequence("crowd", "rgbd_bonn_crowd"), (0.020, 0.025))
        assert head[:6] == ["published ATE", "m", "ours is", "ratio", "rank", "aligned"]
        found = {line[0]: (float(line[1]), line[2]) for line in lines}
        assert found["NGD-SLAM"] == (0.024, "in range")
        assert {verdict for value, verdict in found.values() if value < 0.020} == {"worse"}
        assert {verdict for value, verdict in found.values() if value > 0.025} == {"better"}

    def test_ratio_and_rank(self) -> None:
        """Ours stands where its median belongs, as one more than the systems that are better."""
        _, *lines = self.lines(Sequence("crowd", "rgbd_bonn_crowd"), (0.020, 0.025))
        values = [float(line[1]) for line in lines]
        assert values == sorted(values)
        known = [figure.value for figure in best_of_systems(published_for("rgbd_bonn_crowd"))]
        (ours,) = (line for line in lines if line[0] == "ours")
        assert ours == [
            *("ours", "0.0225", "-", f"{0.0225 / known[0]:.2f}", str(1 + sum(value < 0.0225 for value in known))),
            *("se3", "here, median of 2 runs", ""),
        ]
        best = next(line for line in lines if float(line[1]) == known[0])
        assert best[3:5] == ["1.00", "1"]

    def test_ranks_over_sequences(self) -> None:
        systems = len(best_of_systems(published_for("rgbd_bonn_crowd")))
        rows = rows_of([done("crowd", "first", ate_rmse_m=1e-4), done("crowd", "last", ate_rmse_m=9.0), done("mine")])
        head, first, last = rank_table(CROWD, rows)
        assert head == ["against published ATE", "sequences", "ratio to the best", "mean rank", "of systems"]
        assert first == ["first", "1", "0.01", "1.0", f"{systems + 1}.0"]
        assert (last[0], last[3]) == ("last", f"{systems + 1}.0")
        assert rank_table(CROWD, rows_of([done(tracked=464)])) == []

    def test_another_statistic(self) -> None:
        """That of the protocol, if there are runs enough."""
        suite = Suite("any", "", CROWD.sequences, protocol=Protocol("x", ("ate_rmse_m",), "trimmed_mean"))
        runs = [done(seed=seed, ate_rmse_m=ate) for seed, ate in enumerate((0.01, 0.02, 0.06))]
        lines = published_table(suite, "crowd", rows_of(runs))
        assert ["static", "0.02", "here, trimmed mean of 3 runs"] in [[line[0], line[1], line[-2]] for line in lines]
        assert all(line[0] != "static" for line in published_table(suite, "crowd", rows_of(runs[:2])))

    def test_times_of_other_machines(self) -> None:
        """Beside ours, without a verdict."""
        (time,) = (metric for metric in METRICS if metric.depends_on_machine)
        name = next(f.sequence for paper in load_published() for f in paper.figures if f.metric == time.figure)
        suite = Suite("any", "", (Sequence("any", name),))
        run = done("any", track_ms={"mean": 12.5, "median": 12.0, "p95": 20.0, "max": 30.0})
        head, *lines = published_table(suite, "any", rows_of([run]), time)
        assert head[:3] == ["published time of a frame", "ms", "static is"]
        assert ["static", "12.5", "-"] in [line[:3] for line in lines]
        assert {line[2] for line in lines if line[0] != "static"} == {NO_VERDICT}

    def test_parts_of_systems_in_an_ablation(self) -> None:
        clip = Sequence("w", W)
        whole, parts = (published_table(Suite("any", "", (clip,), ablation=a), "w", []) for a in (False, True))
        assert ["NGD-SLAM, yolo", "0.014"] in [line[:2] for line in parts]
        assert not any("," in line[0] for line in whole)

    def test_wins_and_losses(self) -> None:
        rows = rows_of([done("crowd", "ours"), done("mine", "ours")])
        systems = best_of_systems(published_for("rgbd_bonn_crowd"))
        assert len(systems) == len({figure.system for figure in published_for("rgbd_bonn_crowd")})
        known = [figure.value for figure in systems]
        better, worse = sum(value > 0.02 for value in known), sum(value < 0.02 for value in known)
        ours = ("927", "100.0", "927", "1 of 1")
        assert overview_table(CROWD, rows)[1:] == [
            ["crowd", "0.0200", f"{known[0]:g}", systems[0].system, *ours],
            ["mine", "0.0200", "-", "-", *ours],
        ]
        assert summary_lines(CROWD, rows) == [
            f"ours: against the best published figures 0 better, 0 in range, 1 worse; against all systems {better}"
            f" better, {len(known) - better - worse} in range, {worse} worse"
        ]

    def test_system_of_several_figures_counts_with_its_best(self) -> None:
        make = lambda system, value, variant=None: Figure(
            system, W, "ate_rmse_m", value, "rgbd", "se3", alignment_stated=True, source="Table 1", variant=variant
        )
        figures = [make("A", 0.3), make("B", 0.2), make("A", 0.1), make("C", 0.05, "part")]
        assert [(f.system, f.value) for f in best_of_systems(figures)] == [("A", 0.1), ("B", 0.2)]

    def test_rpe(self) -> None:
        """Beside ours, with a verdict, but where the evaluation says that it says nothing."""
        rows = rows_of([of_w(), of_w(label="noted", evaluation={"notes": [MARKER]})])
        trans, rot = (published_table(TUM, "w", rows, metric) for metric in METRICS[1:3])
        assert trans[0][:4] == ["published RPE", "m/s", "static is", "noted is"]
        assert ["NGD-SLAM", "0.02", "worse", NO_VERDICT] in [line[:4] for line in trans]
        assert ["NGD-SLAM", "0.47", "worse", NO_VERDICT] in [line[:4] for line in rot]

    def test_means_over_kitti(self) -> None:
        runs = [kitti(number, frames) for number, frames in enumerate(KITTI_FRAMES)]
        head, ate, trans, rot = kitti_means(KITTI, rows_of(runs))
        assert head == ["mean over KITTI 00 to 10", "of", "published", "static", "static is"]
        assert ate == ["ATE, m", "ORB-SLAM2", "2.55", "2", "better"]
        assert trans == ["t_rel, %", "ORB-SLAM2", "0.72", "0.75", "worse"]
        assert rot == ["r_rel, deg/100 m", "ORB-SLAM2", "0.22", "0.2", "better"]
        for others in (runs[:-1], [*runs[:-1], kitti(10, 600)]):
            assert [line[3:] for line in kitti_means(KITTI, rows_of(others))[1:]] == [["-", NO_VERDICT]] * 3
        assert not kitti_means(TUM, rows_of([of_w()]))
        assert any(line.startswith("ORB-SLAM2 (") for line in protocols(KITTI, rows_of(runs)))

    def test_protocols(self) -> None:
        lines = protocols(CROWD, rows_of([done("crowd"), done("mine")]))
        assert any(line.startswith("RTS-SLAM (") and "Mean of 20 runs" in line for line in lines)
        assert len(lines) == len({line.partition(" (")[0] for line in lines})
        assert not protocols(CROWD, rows_of([done("mine")]))

    def test_without_a_network(self) -> None:
        """Every run says why; one of a preset that needs a network has another label, and nothing published beside."""
        why = "yolox-nano not on this machine"
        lacking = done(label="ngd", without_network=why, lacks_network=True)
        default = done(label="default", without_network=why)
        assert without_network([lacking, default, done(label="rts")]) == [f"ngd, default: without a network ({why})"]
        text = markdown_report(CROWD, [lacking, default], {})
        assert "| ngd (without a network) | 1 of 1 |" in text
        assert "default is |" in text
        assert "ngd (without a network) is |" not in text
        assert "no verdict for crowd (ngd (without a network)): run without the network that the preset needs" in text
        assert "published ATE" not in markdown_report(CROWD, [lacking], {})

    def test_nothing_about_parts_and_rooms(self) -> None:
        assert not self.lines(Sequence("crowd", "rgbd_bonn_crowd", stop=220), (0.02, 0.03))
        assert not self.lines(Sequence("room", room=SyntheticConfig(frames=5)), (0.02, 0.03))
        assert not self.lines(Sequence("mine", "my_own_recording"), (0.02, 0.03))
        assert published_of(CROWD, "no more in the suite") == []


class TestRemarks:
    """What both reports say before the figures."""

    RUNS = (
        done(evaluation={"notes": [MARKER]}),
        done(label="default", evaluation={"notes": [MARKER]}),
        done("mine", ate_rmse_m=None, ate_sim3_rmse_m=None, evaluation=None, evaluation_problem="no ground truth"),
        not_done("failed", "killed by signal 9", sequence="mine", seed=1),
        not_done("not run", sequence="mine", seed=2),
    )
    SAID = (
        "3 of 5 planned runs are done, 1 failed, 1 not made yet: --resume goes on with them",
        f"note on crowd (static, default): {MARKER}",
        "no ATE of mine (static, 1 of 1 runs): no ground truth",
        "static: 1 runs failed: killed by signal 9",
    )

    def test_markdown(self) -> None:
        text = markdown_report(CROWD, self.RUNS, {})
        assert all(f"- {line}\n" in text for line in self.SAID)
        assert "over the poses matched with ground truth" in " ".join(text.split())

    def test_page(self, tmp_path: Path) -> None:
        """Also where the files of runs, of which pictures would be made, are gone."""
        page = html_report(CROWD, self.RUNS, {}, tmp_path)
        assert all(line in page for line in self.SAID)

    def test_runs_of_several_calls(self) -> None:
        """Those of another version, or of other data under the same name."""
        runs = [done(), done(seed=1, sources_sha256="9", commit="def"), done("mine"), done("mine", data_sha256="8")]
        runs += [done(label="ngd", networks_sha256={"model": sha256}) for sha256 in ("1", "2")]
        assert warnings(CROWD, runs)[-3:] == [
            "runs of several versions of jaxslam stand beside each other: abc; def",
            "mine: its runs are of different recordings",
            "ngd: its runs are of different networks",
        ]

    def test_bar_in_a_label(self) -> None:
        assert to_markdown([Table([["a"], ["x|y"]])]).splitlines()[-1] == r"| x\|y |"

    def test_both_renderings_of_a_report(self) -> None:
        blocks = (Heading("<a>"), Paragraph("b & c"), Bullets(["d"], is_warning=True), Table([["e"], ["worse"]]))
        image = Image(b"f", '"g"', "jpeg", is_folded=True)
        empty = (Paragraph(""), Bullets([]), Table([]))
        assert to_markdown([*blocks, image, *empty]) == (
            '## <a>\n\nb & c\n\n- d\n\n| e |\n| --- |\n| worse |\n\n!["g"](data:image/jpeg;base64,Zg==)\n'
        )
        page = to_html("<t>", [*blocks, image, *empty])
        assert "<title>&lt;t&gt;</title>" in page
        assert '<h2>&lt;a&gt;</h2>\n<p>b &amp; c</p>\n<ul class="failed"><li>d</li></ul>\n' in page
        assert '<td class="worse">worse</td>' in page
        assert '<details><summary>&quot;g&quot;</summary><figure><img alt="&quot;g&quot;" src="data:image/jpeg' in page
        assert to_html("t", empty) == to_html("t", [])


class TestTableFiles:
    LINES = (("preset", "t_rel, %", "> 5"), ("a_b & c", "1,5", r"{x}\y"))

    def test_csv(self) -> None:
        assert to_csv(self.LINES) == 'preset,"t_rel, %",> 5\na_b & c,"1,5",{x}\\y\n'

    def test_latex(self) -> None:
        """Rules of booktabs, and no letter that LaTeX takes for a command."""
        assert to_latex(self.LINES).splitlines() == [
            r"\begin{tabular}{lrr}",
            r"\toprule",
            r"preset & t\_rel, \% & \textgreater{} 5 \\",
            r"\midrule",
            r"a\_b \& c & 1,5 & \{x\}\textbackslash{}y \\",
            r"\bottomrule",
            r"\end{tabular}",
        ]

    def test_of_a_report(self, tmp_path: Path) -> None:
        """Named tables alone; what an earlier report has left goes."""
        (tmp_path / "gone.csv").touch()
        (tmp_path / "mine.txt").touch()
        write_tables(tmp_path, [Heading("x"), Table(self.LINES, "room 1"), Table([["a"]]), Table([], "empty")])
        assert sorted(path.name for path in tmp_path.iterdir()) == ["mine.txt", "room 1.csv", "room 1.tex"]

    def test_names_in_the_report_of_a_suite(self) -> None:
        blocks = suite_report(CROWD, [done(), done("mine")], {})
        assert [block.name for block in blocks if isinstance(block, Table) and block.lines] == [
            *("overview", "comparison", "ranks", "crowd-accuracy", "crowd-running", "crowd-published-ate_rmse_m"),
            *("crowd-published-frame_ms", "mine-accuracy", "mine-running"),
        ]


def test_long_labels_leave_room() -> None:
    """Warnings of Matplotlib, such as of axes without any room, are errors here."""
    label = "static@model=/a/long/path/to/some/folder/of/models/and/" + "x" * 80 + "$1$.onnx"
    axes = plot_spread([done(label=label), done(label="static")])
    assert png(axes)
    names = [text.get_text() for text in axes.axes[0].get_yticklabels()]
    assert len(names[0]) < 35
    assert names[1] == "static"


class TestComparison:
    """The short table of the README: presets, systems that were run too, and published figures."""

    ROOM = Sequence("room", room=SyntheticConfig(people=2))
    SUITE = Suite("any", "", (Sequence("crowd", "rgbd_bonn_crowd"), Sequence("start", "kitti_06", stop=51), ROOM))

    def test_systems_stand_beside_presets(self) -> None:
        results = [
            done(ate_rmse_m=0.01),
            done(label="ORB-SLAM3", ate_rmse_m=0.42, tracked_percent=98.25),
            done(sequence="start", ate_rmse_m=0.03),
            not_done("failed", "killed", sequence="start", seed=1),
            done(sequence="room", label="ORB-SLAM3", ate_rmse_m=None, evaluation=None),
        ]
        head, crowd, start, room = comparison_table(self.SUITE, rows_of(results))
        assert head == ["recording", "static", "ORB-SLAM3", "published"]
        assert crowd[:3] == ["`rgbd_bonn_crowd`", "0.0100 m", "0.4200 m, 98.25 % tracked"]
        assert crowd[3].startswith("DROID-W (mono) 0.013 m, DynaSLAM 0.016 m, Occlusion SLAM 0.0177 m")
        assert start == ["`kitti_06`, first 51 frames", "0.0300 m, 1 of 2 runs", "-", "-"]
        assert room == ["rendered room, path xyz, 2 people", "-", "-", "-"]

    def test_is_a_table_of_the_report(self) -> None:
        assert "| recording | static | published |" in markdown_report(self.SUITE, [done()], {})

    @pytest.mark.parametrize(
        ("sequence", "words"),
        [
            (Sequence("x", "a", start=10), "`a`, frames 10 to the end"),
            (Sequence("x", "a", start=10, stop=20, every=3), "`a`, frames 10 to 19, one frame in 3"),
            (Sequence("x", world="flat"), "`flat`"),
        ],
    )
    def test_describes_parts(self, sequence: Sequence, words: str) -> None:
        assert described(sequence) == words
