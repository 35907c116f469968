"""Rewrite the generated tables: results from stored files, and what is differentiable from the cases of the tests.

Run `python docs/make_tables.py` after a file in `docs/accuracy`, `docs/performance`, `configs/benchmarks/baselines` or
`configs/benchmarks/published` has changed, or `derivative_cases.py` or `step_inputs.py` in `tests/helpers`.
A table stands between the comments `<!-- NAME: begin ... -->` and `<!-- NAME: end -->`; nothing else is touched.
"""

import json
import re
import statistics
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from jaxslam.benchmark.reports.document import Table, to_markdown
from jaxslam.benchmark.reports.live import MEANING, by_program, ratio, section
from jaxslam.benchmark.reports.published_tables import comparison_table, described
from jaxslam.benchmark.suites.accuracy_ruler import AccuracyBaseline, compare_accuracy, load_accuracy_baseline
from jaxslam.benchmark.suites.published import published_for
from jaxslam.benchmark.suites.suite import load_suite
from jaxslam.config.loading import configs_dir

DOCS = Path(__file__).resolve().parent
PAGES = (
    DOCS.parent / "README.md",
    DOCS / "derivatives.md",
    DOCS / "measured-results.md",
    DOCS / "performance.md",
)
_HELPERS = DOCS.parent / "tests" / "helpers"
_SUITE = load_suite("accuracy")
_FROZEN = configs_dir() / "benchmarks" / "baselines" / "accuracy-8561ab9-epyc.json"


def tables() -> dict[str, str]:
    """Make every generated block as Markdown, by the name in its comments."""
    before = load_accuracy_baseline(_FROZEN)
    measured = [load_accuracy_baseline(file) for file in sorted((DOCS / "accuracy").glob("*.json"))]
    return {
        "accuracy": "\n\n".join(accuracy_table(now, before) for now in measured),
        "published": "\n".join(published_tables(measured)),
        "results": results_table(measured[0]),
        "live": live_report(),
        "live_summary": live_summary(),
        "kernels": kernels_table(),
        "tracker": tracker_table(),
    }


def table(columns: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Make a Markdown table."""
    return to_markdown([Table([columns, *rows])])


def accuracy_table(now: AccuracyBaseline, before: AccuracyBaseline) -> str:
    """Make the table of an accuracy measurement, with its ratios to the frozen baseline, under where it was made."""
    reading = compare_accuracy(now.recordings, now.sequences, before)
    rows = []
    for row in reading.recordings:
        low, high = 1e3 * min(row.now.ates_m), 1e3 * max(row.now.ates_m)
        rows.append(
            [
                f"`{row.name}`",
                described(next(clip for clip in _SUITE.sequences if clip.name == row.name)),
                str(row.now.frames),
                str(len(row.now.ates_m)),
                f"{row.now.tracked_percent:.4g} %",
                f"{1e3 * row.now.median_m:.2f} mm",
                f"{low:.2f}-{high:.2f} mm",
                "-" if row.ratio is None else f"{row.ratio:.2f}",
            ]
        )
    columns = ("name", "recording", "frames", "seeds", "tracked", "ATE, median", "ATE, range", f"of {before.commit}")
    where = f"Commit {now.commit[:7]}, preset `{now.preset}`, on {now.machine};\n{now.versions}."
    mean = f"The geometric mean of the medians is {reading.mean_ratio:.3f} of that of the frozen baseline."
    return f"{where}\n{mean}\n\n{table(columns, rows)}"


def live_report() -> str:
    """Make a section of each live measurement, and say what the figures mean."""
    return "\n".join([*map(section, _live_measurements()), MEANING])


def live_summary() -> str:
    """Make the short table of live measurements for README.md: the time of a frame, and its ratio to ORB-SLAM3's."""
    rows = []
    for content in _live_measurements():
        own, theirs = by_program(content["runs"]).values()
        ratios = [f"{ratio(own, theirs, field):.2f}" for field in ("median_ms", "p95_ms", "cpu_ms")]
        median = statistics.median(run["median_ms"] for run in own)
        recording = f"`{content['recording']}`, {content['rate_hz']:g} Hz"
        rows.append([recording, content["cpu"], f"{median:.1f} ms", *ratios])
    columns = ("recording", "CPU", "frame, median", "of ORB-SLAM3's median", "of its p95", "of its processor time")
    return table(columns, rows)


def _live_measurements() -> list[dict[str, Any]]:
    return [json.loads(file.read_text(encoding="utf-8")) for file in sorted((DOCS / "performance").glob("*.json"))]


def kernels_table() -> str:
    """Make the table of what is differentiable in each kernel, from the cases that tests compare with differences."""
    _import_helpers()
    import jax  # noqa: PLC0415 - after the path is set
    from derivative_cases import MAKERS  # noqa: PLC0415 - likewise

    rows = []
    with jax.enable_x64(True):
        for name, each in sorted(MAKERS.items()):
            case = each.make()
            constants = [*map(_code, case.constants), *(f"result `{result}`" for result in case.constant_results)]
            carries = ", ".join(map(_code, case.carries)) or ("none is meant" if case.not_meant else "none")
            rows.append([f"`{name}`", carries, ", ".join(constants) or "-", ", ".join(case.near) or "-"])
    return table(("kernel", "first and second derivative by", "constant", "also compared at"), rows)


def tracker_table() -> str:
    """Make the table of what the tracker is differentiated by, from the inputs of its tests."""
    _import_helpers()
    from step_inputs import CONSTANT_PARAMS, STEP_INPUTS, STEPS, STEPS_TWICE  # noqa: PLC0415 - after the path is set

    rows = [
        [each.words, f"{STEPS} frames", "not compared" if each.second is None else f"{STEPS_TWICE} frames"]
        for each in STEP_INPUTS.values()
    ]
    rows.append([", ".join(map(_code, CONSTANT_PARAMS)), "zero", "zero"])
    return table(("by", "first derivative", "second derivative"), rows)


def _import_helpers() -> None:
    """Make the helpers of tests importable."""
    if str(_HELPERS) not in sys.path:
        sys.path.append(str(_HELPERS))


def _code(label: str) -> str:
    """Format the name of an argument; what follows a colon is the part of it that is meant."""
    name, _, part = label.partition(":")
    return f"`{name}` ({part.strip()})" if part else f"`{name}`"


def published_tables(baselines: list[AccuracyBaseline]) -> list[str]:
    """Make, for every recording that was run whole and has published figures, a table of those figures."""
    parts = []
    for recording in dict.fromkeys(whole for baseline in baselines for whole in whole_recordings(baseline).values()):
        figures = published_for(recording)
        rows = [
            [
                figure.system,
                f"{figure.value:g} m",
                figure.sensor,
                figure.alignment + ("" if figure.alignment_stated else ", not stated"),
                figure.source + (f" (reported by {figure.reported_by})" if figure.reported_by else ""),
            ]
            for figure in figures
        ]
        if rows:
            parts.append(f"`{recording}`:\n\n" + table(("system", "ATE", "sensor", "alignment", "source"), rows))
    return parts


def results_table(baseline: AccuracyBaseline) -> str:
    """Make the short table of README.md, as `jaxslam bench` prints it, of a baseline."""
    rows = [
        {
            "sequence": name,
            "label": baseline.preset,
            "ate_rmse_m": {"median": runs.median_m},
            "tracked_percent": {"least": runs.tracked_percent},
            "done": len(runs.ates_m),
            "runs": len(runs.ates_m),
        }
        for name, runs in baseline.recordings.items()
    ]
    return to_markdown([Table(comparison_table(_SUITE, rows))])


def whole_recordings(baseline: AccuracyBaseline) -> dict[str, str]:
    """List the sequences that are whole recordings, with the name of the recording."""
    return {
        name: sequence["recording"]
        for name, sequence in baseline.sequences.items()
        if "recording" in sequence and "stop" not in sequence
    }


def with_tables(text: str, blocks: Mapping[str, str]) -> str:
    """Put the blocks between their comments in the text of a page.

    Raises:
        ValueError: If the text has comments for a block that is unknown.
    """

    def filled(match: re.Match[str]) -> str:
        if match["name"] not in blocks:
            raise ValueError(f"{match['name']}: expected one of {', '.join(blocks)}")
        return f"{match['begin']}\n{blocks[match['name']].strip()}\n{match['end']}"

    pattern = r"(?P<begin><!-- (?P<name>\w+): begin[^>]*-->)\n.*?(?P<end><!-- (?P=name): end -->)"
    return re.sub(pattern, filled, text, flags=re.DOTALL)


def main() -> None:
    """Rewrite the tables of every page."""
    blocks = tables()
    for page in PAGES:
        page.write_text(with_tables(page.read_text(encoding="utf-8"), blocks), encoding="utf-8")


if __name__ == "__main__":
    main()
