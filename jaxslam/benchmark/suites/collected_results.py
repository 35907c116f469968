"""The results of a suite in one file, a row a run: those of this call, and those of earlier ones it goes on with."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from jaxslam.benchmark.suites.job import DONE, Job, not_run
from jaxslam.errors import BenchmarkError
from jaxslam.io.atomic_files import write_atomically

RESULTS = "results.json"
ALWAYS = (
    *("frames", "images", "tracked", "tracked_percent", "dropped", "dropped_percent", "status_counts", "relocalized"),
    *("first_loss_s", "ate_rmse_m", "ate_sim3_rmse_m", "rpe_trans_m_per_s", "rpe_rot_deg_per_s", "evaluation"),
    *("evaluation_problem", "track_ms", "stage_ms", "mask_age_frames", "rate_hz", "flow_ms", "wall_s", "peak_rss_mb"),
    *("process_wall_s", "process_cpu_s"),
    *("cpu", "cores", "versions", "commit", "deterministic", "realtime", "model", "networks_sha256", "data_sha256"),
    *("without_network", "lacks_network"),
)
"""What every row has, also where no run was made to its end whose keys could be taken."""

_Key = tuple[str, str, int]


class Collected:
    """Results by sequence, label and seed, in the order in which they were planned.

    Every planned run is there from the beginning, as one that was not run.
    """

    def __init__(self, jobs: Sequence[Job], earlier: Sequence[dict[str, Any]] = ()) -> None:
        """Begin with planned runs.

        Args:
            jobs: Planned runs.
            earlier: From `read_results`; what is planned again is replaced.
        """
        self._results: dict[_Key, dict[str, Any]] = {_key(result): result for result in earlier}
        self._planned = {_key(result): None for result in map(not_run, jobs)}
        self._results |= {_key(result): result for result in map(not_run, jobs)}

    def add(self, result: dict[str, Any]) -> None:
        """Put the result of a planned run in its place."""
        self._results[_key(result)] = result

    @property
    def planned(self) -> list[dict[str, Any]]:
        """Results of what is planned now."""
        return [self._results[key] for key in self._planned]

    @property
    def every(self) -> list[dict[str, Any]]:
        """All results, earlier ones too."""
        return list(self._results.values())

    def write(self, out: Path) -> None:
        """Write all results, each with the keys of all: `None` for what a run that failed or was not made has not.

        Raises:
            BenchmarkError: If they cannot be written.
        """
        write_atomically(out / RESULTS, (json.dumps(as_table(self.every), indent=1) + "\n").encode(), BenchmarkError)


def as_table(results: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Results with the same keys each, in the order of those of a run that is done."""
    first = sorted(results, key=lambda result: result["status"] != DONE)
    keys = dict.fromkeys((*(key for result in first for key in result), *ALWAYS))
    return [{key: result.get(key) for key in keys} for result in results]


def read_results(out: Path) -> list[dict[str, Any]]:
    """The results that an earlier call has left in a folder; none if it has left none.

    Raises:
        BenchmarkError: If there is a file that holds something else.
    """
    path = out / RESULTS
    try:
        content = json.loads(path.read_text())
        if not all({"sequence", "label", "seed", "status", "problem"} <= result.keys() for result in content):
            raise BenchmarkError(f"{path}: expected the results of a suite, got rows without sequence, label or status")
    except FileNotFoundError:
        return []
    except (OSError, ValueError, TypeError, AttributeError) as problem:
        raise BenchmarkError(f"{path}: expected the results of a suite, got something unreadable: {problem}") from None
    return content


def _key(result: Mapping[str, Any]) -> _Key:
    return result["sequence"], result["label"], result["seed"]
