"""Published figures: the data files, what is read from them, and how ours compare."""

import math
import re
import tomllib
from collections.abc import Callable
from pathlib import Path

import pytest

from jaxslam.benchmark.suites.published import (
    Figure,
    PublishedSystem,
    load_published,
    published_for,
    read_published,
    verdict,
)
from jaxslam.benchmark.suites.published_comparison import published_of
from jaxslam.benchmark.suites.suite import load_suite, suites
from jaxslam.config.loading import configs_dir
from jaxslam.datasets.loaders import bonn, tum
from jaxslam.datasets.protocol import Fit
from jaxslam.errors import ConfigError
from jaxslam.sensors.camera import Camera

ROOT = Path(__file__).resolve().parents[3]
FOLDER = configs_dir() / "benchmarks" / "published"
W = "rgbd_dataset_freiburg3_walking_"
S = "rgbd_dataset_freiburg3_sitting_"
B = "rgbd_bonn_"
FR1 = "rgbd_dataset_freiburg1_"
ATE, TRANS, ROT = "ate_rmse_m", "rpe_trans_m_per_s", "rpe_rot_deg_per_s"
COLLECTION = "Collection of best figures"

# Paper, system, variant, sequence, metric, figure: typed from the papers, apart from the data files.
TYPED = [
    ("NGD-SLAM", "NGD-SLAM", None, W + "xyz", ATE, 0.015),
    ("NGD-SLAM", "NGD-SLAM", None, W + "rpy", ROT, 0.889),
    ("NGD-SLAM", "NGD-SLAM", None, W + "halfsphere", TRANS, 0.025),
    ("NGD-SLAM", "NGD-SLAM", None, W + "static", ROT, 0.262),
    ("NGD-SLAM", "NGD-SLAM", None, B + "person_tracking2", ATE, 0.062),
    ("NGD-SLAM", "NGD-SLAM", None, B + "moving_nonobstructing_box", ATE, 0.016),
    ("NGD-SLAM", "NGD-SLAM", "yolo", W + "rpy", ATE, 0.041),
    ("NGD-SLAM", "NGD-SLAM", "mask-propagation", W + "halfsphere", ATE, 0.028),
    ("NGD-SLAM", "ORB-SLAM3", None, W + "rpy", ATE, 0.639),
    ("NGD-SLAM", "RDS-SLAM", None, W + "rpy", ROT, 13.169),
    ("NGD-SLAM", "CFP-SLAM", None, W + "rpy", TRANS, 0.054),
    ("NGD-SLAM", "DFS-SLAM", None, W + "rpy", ATE, 0.027),
    ("NGD-SLAM", "ReFusion", None, B + "person_tracking2", ATE, 0.463),
    ("NGD-SLAM", "DynaSLAM", None, B + "moving_nonobstructing_box", ATE, 0.232),
    ("NGD-SLAM", "ACEFusion", None, B + "crowd3", ATE, 0.023),
    ("TRS-SLAM", "TRS-SLAM", None, S + "xyz", ATE, 0.0117),
    ("TRS-SLAM", "TRS-SLAM", None, W + "rpy", TRANS, 0.0471),
    ("TRS-SLAM", "TRS-SLAM", None, W + "halfsphere", ROT, 0.9650),
    ("TRS-SLAM", "TRS-SLAM", "geometry", W + "rpy", ATE, 0.2143),
    ("TRS-SLAM", "TRS-SLAM", "semantic", W + "static", ATE, 0.0177),
    ("TRS-SLAM", "ORB-SLAM2", None, S + "halfsphere", ATE, 0.0242),
    ("TRS-SLAM", "MID-Fusion", None, S + "xyz", ATE, 0.062),
    ("TRS-SLAM", "StaticFusion", None, W + "halfsphere", ROT, 5.04),
    ("TRS-SLAM", "DS-SLAM", None, W + "rpy", ROT, 3.0042),
    ("USD-SLAM", "USD-SLAM", None, W + "halfsphere", ATE, 0.020),
    ("USD-SLAM", "USD-SLAM", None, B + "moving_obstructing_box2", ATE, 0.178),
    ("USD-SLAM", "USD-SLAM", "segmentation", W + "rpy", ATE, 0.058),
    ("USD-SLAM", "USD-SLAM", None, "kitti_06", ATE, 0.69),
    ("USD-SLAM", "USD-SLAM", "segmentation", "kitti_09", ATE, 3.73),
    ("USD-SLAM", "ORB-SLAM2", None, "kitti_01", ATE, 10.40),
    ("USD-SLAM", "DynaSLAM II", None, "kitti_06", ATE, 0.72),
    ("USD-SLAM", "Dynamic SLAM", None, "kitti_07", ATE, 0.52),
    ("USD-SLAM", "LC-CRF-SLAM", None, B + "balloon2", ATE, 0.026),
    ("USD-SLAM", "DN-SLAM", None, B + "moving_obstructing_box2", ATE, 0.120),
    ("RTS-SLAM", "RTS-SLAM", None, W + "rpy", ATE, 0.0254),
    ("RTS-SLAM", "RTS-SLAM", None, W + "static", "ate_std_m", 0.0033),
    ("RTS-SLAM", "RTS-SLAM", None, W + "halfsphere", "ate_median_m", 0.0171),
    ("RTS-SLAM", "RTS-SLAM", None, S + "static", ROT, 0.2750),
    ("RTS-SLAM", "RTS-SLAM", None, B + "synchronous", ATE, 0.0823),
    ("RTS-SLAM", "RTS-SLAM", "geometric", W + "rpy", ATE, 0.2350),
    ("RTS-SLAM", "RTS-SLAM", "semantic", W + "halfsphere", ATE, 0.0763),
    ("RTS-SLAM", "RTS-SLAM", "semantic-geometric", S + "static", ATE, 0.0079),
    ("RTS-SLAM", "YOLO-SLAM", None, B + "synchronous2", ATE, 0.007),
    ("RTS-SLAM", "SG-SLAM", None, B + "synchronous", ATE, 0.3229),
    ("RTS-SLAM", "COEB-SLAM", None, W + "xyz", ATE, 0.0182),
    ("RTS-SLAM", "ORB-SLAM3", None, W + "rpy", ATE, 0.8656),
    ("RTS-SLAM", "ORB-SLAM2", None, B + "crowd2", ATE, 1.3573),
    ("Occlusion SLAM", "Occlusion SLAM", None, W + "halfsphere", ATE, 0.0286),
    ("Occlusion SLAM", "Occlusion SLAM", "segmentation", B + "crowd2", ATE, 0.1243),
    ("Occlusion SLAM", "Occlusion SLAM", None, B + "crowd2", "frame_ms", 21.25),
    ("Occlusion SLAM", "SG-SLAM", None, B + "crowd3", ATE, 0.1060),
    ("Occlusion SLAM", "ORB-SLAM2", None, B + "crowd2", ATE, 1.4830),
    ("Occlusion SLAM", "Crowd-SLAM", None, B + "crowd", ATE, 0.0184),
    (COLLECTION, "CFP-SLAM", None, S + "xyz", ATE, 0.0090),
    (COLLECTION, "ORB-SLAM2", None, S + "rpy", ATE, 0.0195),
    (COLLECTION, "DynaMoN", None, B + "person_tracking2", ATE, 0.022),
    (COLLECTION, "WF-SLAM", None, W + "rpy", ATE, 0.0252),
    (COLLECTION, "WF-SLAM", None, W + "xyz", ATE, 0.0127),
    (COLLECTION, "WF-SLAM", None, S + "xyz", ATE, 0.0087),
    (COLLECTION, "WildGS-SLAM with sensor depth", None, W + "halfsphere", ATE, 0.014),
    (COLLECTION, "Dream-SLAM", None, B + "person_tracking", ATE, 0.015),
    (COLLECTION, "Dream-SLAM", None, B + "moving_nonobstructing_box", ATE, 0.006),
    (COLLECTION, "Dream-SLAM", None, B + "moving_nonobstructing_box2", ATE, 0.014),
    (COLLECTION, "Dream-SLAM", None, B + "balloon2", ATE, 0.019),
    (COLLECTION, "Dream-SLAM", None, W + "static", ATE, 0.003),
    (COLLECTION, "Dream-SLAM", None, S + "static", ATE, 0.003),
    (COLLECTION, "Dream-SLAM", None, S + "xyz", ATE, 0.006),
    (COLLECTION, "best system with a GPU, not named", None, FR1 + "xyz", ATE, 0.009),
    (COLLECTION, "best system with a GPU, not named", None, FR1 + "rpy", ATE, 0.017),
    (COLLECTION, "best system, not named", None, FR1 + "desk", ATE, 0.0148),
    (COLLECTION, "best system without a GPU, not named", None, FR1 + "xyz", ATE, 0.011),
    (COLLECTION, "best system without a GPU, not named", None, FR1 + "rpy", ATE, 0.022),
    (COLLECTION, "best system without a GPU, not named", None, FR1 + "desk", ATE, 0.016),
    (COLLECTION, "ORB-SLAM2", None, FR1 + "desk2", ATE, 0.022),
    (COLLECTION, "DVO-SLAM", None, FR1 + "room", ATE, 0.043),
    (COLLECTION, "OV2SLAM", None, "kitti_00", ATE, 1.17),
    (COLLECTION, "OV2SLAM", None, "kitti_07", ATE, 0.37),
    (COLLECTION, "OV2SLAM", None, "kitti_09", ATE, 1.59),
    ("ORB-SLAM2", "ORB-SLAM2", None, "kitti_00", ATE, 1.3),
    ("ORB-SLAM2", "ORB-SLAM2", None, "kitti_07", ATE, 0.5),
    ("ORB-SLAM2", "ORB-SLAM2", None, "kitti_09", ATE, 3.2),
]
# Suite: paper; preset of each column, and its system and variant in the data files; the table of the paper, ATE in m.
ABLATIONS = {
    "ngd_ablation": (
        "NGD-SLAM",
        {
            "static": ("ORB-SLAM3", None),
            "ngd-detector": ("NGD-SLAM", "yolo"),
            "ngd-propagation": ("NGD-SLAM", "mask-propagation"),
            "ngd-published": ("NGD-SLAM", None),
        },
        {
            W + "xyz": (0.390, 0.014, 0.014, 0.015),
            W + "rpy": (0.639, 0.041, 0.037, 0.034),
            W + "halfsphere": (0.431, 0.023, 0.028, 0.024),
            W + "static": (0.096, 0.007, 0.007, 0.007),
        },
    ),
    "trs_ablation": (
        "TRS-SLAM",
        {
            "static": ("ORB-SLAM2", None),
            "trs-geometry": ("TRS-SLAM", "geometry"),
            "trs-semantics": ("TRS-SLAM", "semantic"),
            "trs-published": ("TRS-SLAM", None),
        },
        {
            S + "xyz": (0.0094, 0.0100, 0.0116, 0.0117),
            S + "halfsphere": (0.0242, 0.0187, 0.0174, 0.0172),
            W + "static": (0.1908, 0.0111, 0.0177, 0.0111),
            W + "rpy": (0.8467, 0.2143, 0.0373, 0.0371),
            W + "xyz": (0.4662, 0.0290, 0.0217, 0.0194),
            W + "halfsphere": (0.4430, 0.0362, 0.0295, 0.0290),
        },
    ),
    "rts_ablation": (  # Table 7; the world as static is in Table 1
        "RTS-SLAM",
        {
            "static": ("ORB-SLAM2", None),
            "rts-semantics": ("RTS-SLAM", "semantic"),
            "rts-epipolar": ("RTS-SLAM", "geometric"),
            "rts-semantics-epipolar": ("RTS-SLAM", "semantic-geometric"),
            "rts-published": ("RTS-SLAM", None),
        },
        {
            W + "xyz": (0.8882, 0.0181, 0.0216, 0.0170, 0.0161),
            W + "static": (0.3455, 0.0094, 0.0102, 0.0077, 0.0069),
            W + "rpy": (0.6435, 0.0359, 0.2350, 0.0310, 0.0254),
            W + "halfsphere": (0.3531, 0.0763, 0.0400, 0.0306, 0.0245),
            S + "static": (0.0101, 0.0083, 0.0099, 0.0079, 0.0068),
        },
    ),
    "usd_ablation": (
        "USD-SLAM",
        {
            "static": ("ORB-SLAM2", None),
            "usd-segmentation": ("USD-SLAM", "segmentation"),
            "usd-published": ("USD-SLAM", None),
        },
        {
            W + "xyz": (0.459, 0.037, 0.035),
            W + "halfsphere": (0.351, 0.021, 0.020),
            W + "rpy": (0.662, 0.058, 0.035),
            B + "balloon": (0.065, 0.029, 0.028),
            B + "balloon2": (0.230, 0.030, 0.029),
            B + "crowd2": (0.603, 0.028, 0.028),
            B + "crowd3": (0.524, 0.029, 0.026),
            B + "person_tracking": (0.796, 0.029, 0.028),
            B + "person_tracking2": (1.068, 0.046, 0.041),
            B + "moving_obstructing_box2": (0.622, 0.173, 0.178),
        },
    ),
    "occlusion_ablation": (  # Table 2; the world as static is in Table 1
        "Occlusion SLAM",
        {
            "static": ("ORB-SLAM2", None),
            "occlusion-masks": ("Occlusion SLAM", "segmentation"),
            "occlusion-published": ("Occlusion SLAM", None),
        },
        {
            W + "xyz": (0.8665, 0.0153, 0.0152),
            W + "static": (0.4702, 0.0067, 0.0065),
            W + "halfsphere": (0.4310, 0.0276, 0.0286),
            B + "crowd": (0.8780, 0.0213, 0.0177),
            B + "crowd2": (1.4830, 0.1243, 0.0459),
            B + "crowd3": (1.1830, 0.0405, 0.0332),
        },
    ),
}
FIGURES = [figure for paper in load_published() for figure in paper.figures]
SEQUENCES = sorted({figure.sequence for figure in FIGURES})


def paper(name: str) -> PublishedSystem:
    (found,) = [published for published in load_published() if published.name == name]
    return found


class TestDataFiles:
    def test_every_file_loads(self) -> None:
        names = {"ngd", "trs", "usd", "rts", "occlusion", "orb-slam2", "best"}
        assert {path.stem for path in FOLDER.glob("*.yaml")} == names
        assert len(load_published()) == len(names)
        assert load_published()[-1].name == COLLECTION

    @pytest.mark.parametrize(("of", "system", "variant", "sequence", "metric", "value"), TYPED)
    def test_figure_is_that_of_the_paper(
        self, of: str, system: str, variant: str | None, sequence: str, metric: str, value: float
    ) -> None:
        wanted = (system, variant, sequence, metric)
        found = [f.value for f in paper(of).figures if (f.system, f.variant, f.sequence, f.metric) == wanted]
        assert found == [value]

    @pytest.mark.parametrize("suite", ABLATIONS)
    def test_ablation_is_that_of_the_paper(self, suite: str) -> None:
        of, columns, table = ABLATIONS[suite]
        found = {(f.system, f.variant, f.sequence): f.value for f in paper(of).figures if f.metric == ATE}
        for sequence, row in table.items():
            assert tuple(found[*column, sequence] for column in columns.values()) == row, sequence
        variants = {figure.variant for figure in paper(of).variants}
        assert variants == {variant for _, variant in columns.values() if variant}

    @pytest.mark.parametrize("suite", ABLATIONS)
    def test_suite_runs_what_the_paper_ran(self, suite: str) -> None:
        """A preset for every column, then ours, every sequence whole, and the published figures of parts."""
        _, columns, table = ABLATIONS[suite]
        ours = load_suite(suite)
        assert ours.presets == (*columns, list(columns)[-1].removesuffix("-published"))
        assert [clip.recording for clip in ours.sequences] == list(table)
        assert ours.ablation
        assert not ours.settings
        assert not ours.variants
        for clip in ours.sequences:
            shown = {(figure.system, figure.variant) for figure in published_of(ours, clip.name)}
            assert shown >= {column for column in columns.values() if column[0] != "ORB-SLAM2"}

    def test_every_ablation_suite_is_of_a_table(self) -> None:
        texts = {name: path.read_text(encoding="utf-8") for name, path in suites().items()}
        assert {name for name, text in texts.items() if "ablation: true" in text} == set(ABLATIONS)

    def test_figures_are_finite_and_positive(self) -> None:
        numbers = [figure.value for figure in FIGURES]
        numbers += [number for published in load_published() for _, number in published.overall]
        assert len(FIGURES) > 600
        assert all(math.isfinite(number) and number > 0 for number in numbers)

    def test_every_source_names_a_table(self) -> None:
        named = [f for f in FIGURES if re.match(r"Tables? ([IV]+|\d)", f.source)]
        assert {figure.reported_by for figure in FIGURES if figure not in named} == {COLLECTION}

    @pytest.mark.parametrize("sequence", SEQUENCES)
    def test_sequence_is_one_that_loaders_recognize(self, sequence: str, tmp_path: Path) -> None:
        folder = tmp_path / sequence
        folder.mkdir()
        (folder / "rgb.txt").touch()
        (folder / "depth.txt").touch()
        if sequence.startswith("kitti_"):
            assert 0 <= int(sequence.removeprefix("kitti_")) <= 10  # those with ground truth
        elif sequence.startswith(B):
            assert bonn.LOADER.fit(folder) is Fit.NAME
            assert bonn.LOADER.camera(folder) == Camera.load("bonn")
        else:
            assert tum.LOADER.fit(folder) is Fit.NAME
            number = sequence.removeprefix("rgbd_dataset_freiburg")[0]
            assert tum.LOADER.camera(folder) == Camera.load(f"tum_fr{number}")

    def test_kitti_is_stereo_and_the_rest_is_not(self) -> None:
        assert all((figure.sensor == "stereo") == figure.sequence.startswith("kitti_") for figure in FIGURES)

    def test_monocular_figures_say_that_the_scale_was_fitted(self) -> None:
        assert {figure.system for figure in FIGURES if figure.sensor == "mono"} == {
            figure.system for figure in FIGURES if figure.alignment == "sim3"
        }

    def test_means_agree_with_the_rows(self) -> None:
        rts = paper("RTS-SLAM")
        for metric, name in ((ATE, "mean_ate_rmse_m"), ("ate_std_m", "mean_ate_std_m")):
            rows = [f.value for f in rts.own if f.metric == metric and f.sequence.startswith("rgbd_dataset")]
            assert len(rows) == 5
            assert sum(rows) / 5 == pytest.approx(dict(rts.overall)[name], abs=6e-5)
        ngd = dict(paper("NGD-SLAM").overall)
        parts = ("keyframe_mask_propagation_ms", "keyframe_flow_ms", "keyframe_orb_ms")
        assert sum(ngd[part] for part in parts) == pytest.approx(ngd["keyframe_ms"])

    def test_nothing_unreserved_beats_the_collection(self) -> None:
        """A figure of a paper that is better than the collected best of its kind is missing there, or doubtful."""
        for best in (figure for figure in FIGURES if figure.reported_by == COLLECTION and figure.sensor == "rgbd"):
            rivals = [f for f in published_for(best.sequence) if f.sensor == "rgbd" and not f.note]
            assert all(rival.value >= best.value - 1e-12 for rival in rivals[:1]), (best, rivals)

    def test_collection_agrees_with_the_papers_it_names(self) -> None:
        reports = {(f.system, f.sequence, f.value) for f in FIGURES if f.reported_by != COLLECTION and f.metric == ATE}
        for figure in paper(COLLECTION).figures:
            named = figure.source != "not stated"
            assert named == ((figure.system, figure.sequence, figure.value) in reports), figure

    def test_wheel_takes_the_folder_along(self) -> None:
        build = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["hatch"]["build"]
        assert build["targets"]["wheel"]["force-include"]["configs"] == "jaxslam/_configs"
        assert FOLDER.is_relative_to(ROOT / "configs")


class TestPublishedFor:
    def test_from_best_to_worst(self) -> None:
        for sequence in SEQUENCES:
            values = [figure.value for figure in published_for(sequence)]
            assert values
            assert values == sorted(values)

    def test_own_paper_goes_before_reports(self) -> None:
        trs = [figure for figure in published_for(W + "xyz") if figure.system == "TRS-SLAM"]
        assert [(figure.value, figure.reported_by) for figure in trs] == [(0.0194, None)]
        (best,) = [figure for figure in published_for(W + "rpy") if figure.system == "RTS-SLAM"]
        assert best.reported_by is None  # the collection has it too

    def test_same_number_from_several_papers_is_one_figure(self) -> None:
        found = [f for f in published_for(W + "xyz") if (f.system, f.value) == ("DynaSLAM", 0.015)]
        assert [figure.reported_by for figure in found] == ["NGD-SLAM, TRS-SLAM, USD-SLAM"]
        assert found[0].source == "Table I of NGD-SLAM; Table II of TRS-SLAM; Table I of USD-SLAM"

    def test_different_numbers_are_all_there(self) -> None:
        found = {f.reported_by: f.value for f in published_for(W + "xyz") if f.system == "ORB-SLAM2"}
        assert found == {"TRS-SLAM": 0.4662, "USD-SLAM": 0.459, "RTS-SLAM": 0.8882, "Occlusion SLAM": 0.8665}

    def test_collection_speaks_where_no_paper_does(self) -> None:
        best = published_for(B + "crowd")[0]
        assert (best.system, best.alignment, best.reported_by) == ("DROID-W", "sim3", COLLECTION)
        ace = [figure for figure in published_for(B + "crowd") if figure.system == "ACEFusion"]
        assert [figure.reported_by for figure in ace] == ["NGD-SLAM"]

    def test_variants_on_request(self) -> None:
        assert all(figure.variant is None for figure in published_for(W + "rpy"))
        found = {(f.system, f.variant): f.value for f in published_for(W + "rpy", variants=True) if f.variant}
        assert found[("RTS-SLAM", "geometric")] == 0.2350
        assert found[("TRS-SLAM", "semantic")] == 0.0373

    def test_other_metrics(self) -> None:
        assert published_for(W + "static", ROT)[0].value == 0.2263
        assert published_for(W + "static", TRANS)[0].note  # the paper contradicts itself about the unit

    def test_unknown_recording_has_none(self) -> None:
        assert published_for("kitchen_people") == []

    def test_unknown_metric(self) -> None:
        with pytest.raises(ConfigError, match=r"^metric: expected a known one, got 'ate_rms_m'.*'ate_rmse_m'"):
            published_for(W + "xyz", "ate_rms_m")


class TestVerdict:
    @pytest.mark.parametrize(
        ("published", "expected"),
        [(0.021, "better"), (0.020, "in range"), (0.015, "in range"), (0.010, "in range"), (0.009, "worse")],
    )
    def test_in_range_is_within_our_runs(self, published: float, expected: str) -> None:
        assert verdict(0.010, 0.020, published) == expected

    def test_a_single_run(self) -> None:
        assert verdict(0.01, 0.01, 0.01) == "in range"
        assert verdict(0.01, 0.01, 0.02) == "better"

    @pytest.mark.parametrize("ours", [(0.02, 0.01), (math.nan, 0.02), (0.01, math.inf)])
    def test_impossible(self, ours: tuple[float, float]) -> None:
        with pytest.raises(ConfigError, match="verdict: expected finite figures"):
            verdict(*ours, 0.01)


HEAD = """
name: A-SLAM
title: A
authors: A
venue: A
year: 2020
link: null
sensor: rgbd
alignment: se3
alignment_stated: true
protocol: all frames
source: Table 1
"""
TABLE = "tables:\n  - source: Table 1\n"
ROW = f"    figures:\n      {W}xyz: "


@pytest.fixture
def read(tmp_path: Path) -> Callable[[str], PublishedSystem]:
    path = tmp_path / "a.yaml"

    def write_and_read(text: str) -> PublishedSystem:
        path.write_text(text, encoding="utf-8")
        return read_published(path)

    return write_and_read


class TestReading:
    def test_own_variant_and_reported(self, read: Callable[[str], PublishedSystem]) -> None:
        second = "  - source: Table 2\n    variant: half\n    metric: ate_rmse_m\n" + ROW + "2\n"
        third = "  - source: Table 3\n    system: B\n    sensor: mono\n    alignment: sim3\n    note: odd\n"
        found = read(HEAD + TABLE + ROW + "{ate_rmse_m: 1}\n" + second + third + ROW + "{ate_rmse_m: 3}\n")
        shared = {"sequence": W + "xyz", "metric": ATE, "alignment_stated": True}
        assert found.own == (
            Figure("A-SLAM", value=1.0, sensor="rgbd", alignment="se3", source="Table 1", **shared),  # type: ignore[arg-type]
        )
        assert [(f.variant, f.value, f.reported_by) for f in found.variants] == [("half", 2.0, None)]
        (other,) = found.reported
        assert (other.system, other.sensor, other.alignment, other.note) == ("B", "mono", "sim3", "odd")
        assert other.reported_by == "A-SLAM"

    @pytest.mark.parametrize(
        ("text", "message"),
        [
            (HEAD + "titel: A\n" + TABLE, r"unknown key 'titel' \(did you mean 'title'\?\)"),
            (HEAD, "missing 'tables'"),
            (HEAD.replace("2020", "'2020'") + TABLE, "year: expected an integer or null, got '2020'"),
            (HEAD.replace("se3", "se2") + TABLE, "alignment: expected one of 'se3', 'sim3', got 'se2'"),
            (HEAD + "tables: 3\n", "tables: expected a list, .* got 3"),
            (HEAD + "tables: [3]\n", r"tables\[0\]: expected `key: value` lines, got 3"),
            (HEAD + TABLE, r"tables\[0\]: missing 'figures'"),
            (HEAD + TABLE + "    metrics: ate_rmse_m\n" + ROW + "1\n", r"tables\[0\]: unknown key 'metrics'"),
            (HEAD + TABLE + ROW + "{ate_rmse_m: -0.01}\n", f"figures: {W}xyz: ate_rmse_m: expected .* > 0, got -0.01"),
            (HEAD + TABLE + ROW + "{ate_rmse_m: .nan}\n", "ate_rmse_m: expected a finite number > 0, got nan"),
            (HEAD + TABLE + ROW + "{ate_rmse_m: '0.1'}\n", "ate_rmse_m: expected a finite number > 0, got '0.1'"),
            (HEAD + TABLE + ROW + "{ate_rmse: 0.1}\n", f"figures: {W}xyz: unknown key 'ate_rmse' .*'ate_rmse_m'"),
            (HEAD + TABLE + ROW + "0.1\n", f"figures: {W}xyz: expected `key: value` lines, got 0.1"),
            (HEAD + TABLE + ROW.replace("freiburg3", "freiburg4") + "{ate_rmse_m: 1}\n", "expected the folder of a"),
            (
                HEAD + TABLE + ROW + "{ate_rmse_m: 1}\n  - source: Table 2\n" + ROW + "{ate_rmse_m: 2}\n",
                f"{W}xyz: ate_rmse_m: expected one figure of A-SLAM, got 1 of Table 1 and 2 of Table 2",
            ),
            (HEAD + TABLE + ROW + "{ate_rmse_m: 1, ate_rmse_m: 2}\n", "'ate_rmse_m' stands twice"),
            (HEAD + "overall: {frame_ms: 0}\n" + TABLE + ROW + "{ate_rmse_m: 1}\n", "overall: frame_ms: expected"),
        ],
    )
    def test_malformed(self, text: str, message: str, read: Callable[[str], PublishedSystem]) -> None:
        with pytest.raises(ConfigError, match=message) as raised:
            read(text)
        assert "a.yaml" in str(raised.value)
        assert "\n" not in str(raised.value)
