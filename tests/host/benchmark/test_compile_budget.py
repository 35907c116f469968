"""The budget of the step: the two programs of a frame are as large as it says, and what is said if they are not."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from jaxslam.benchmark.compiling.budget import (
    BUDGET_PARTS,
    UPDATE,
    Budget,
    ProgramBudget,
    advice,
    load_budget,
    make_budget,
    off_budget,
    save_budget,
)
from jaxslam.benchmark.compiling.part_process import PartJob, measure_part
from jaxslam.errors import BenchmarkError
from jaxslam.runtime.machine import machine

BUDGET = Path(__file__).resolve().parents[3] / ".ci" / "compile_budget.json"
SIZES = ProgramBudget(1000, 100, {"pose.p3p": 600, "se3.retract": 400})
SMALL = Budget("a CPU (avx2)", "jaxlib 1.0", {"track_followed": SIZES})


@pytest.mark.slow
def test_step_is_within_its_budget() -> None:
    """Compiles both programs of a frame. Counts are equal with SSE4.2, AVX2 and AVX-512, with one thread and two."""
    budget = load_budget(BUDGET)
    rows = [row for part in BUDGET_PARTS for row in measure_part(PartJob(part), plain=True)]
    now = make_budget(rows, machine())
    off = off_budget(budget, now)
    assert not off, "\n".join([*off, advice(budget, now)])
    assert sorted(now.programs) == sorted(budget.programs) == ["follow_points", "track_followed"]
    for program in now.programs.values():
        assert sum(program.functions.values()) == program.instructions


def with_sizes(**sizes: Any) -> Budget:
    return replace(SMALL, programs={"track_followed": replace(SIZES, **sizes)})


class TestOff:
    @pytest.mark.parametrize("sizes", [{}, {"instructions": 1020}, {"kernels": 102}, {"instructions": 901}])
    def test_nothing_near_the_budget(self, sizes: dict[str, int]) -> None:
        assert off_budget(SMALL, with_sizes(**sizes)) == []

    def test_growth_names_functions(self) -> None:
        functions = {"pose.p3p": 590, "se3.retract": 420, "new.one": 30}
        assert off_budget(SMALL, with_sizes(instructions=1040, functions=functions)) == [
            "track_followed: 1,040 instructions, 4.0 % above the budget of 1,000;"
            " grown most: new.one +30, se3.retract +20"
        ]
        assert off_budget(SMALL, with_sizes(kernels=103)) == [
            "track_followed: 103 kernels, 3.0 % above the budget of 100; grown most: no function"
        ]

    def test_slack_is_to_be_taken_in(self) -> None:
        (said,) = off_budget(SMALL, with_sizes(instructions=880))
        assert said == (
            "track_followed: 880 instructions, 12.0 % below the budget of 1,000: lower the budget, or it guards nothing"
        )

    def test_program_that_is_gone(self) -> None:
        now = replace(SMALL, programs={"other": SIZES})
        assert off_budget(SMALL, now) == ["track_followed: expected such a program, got other"]

    def test_advice_names_the_command_and_another_machine(self) -> None:
        assert advice(SMALL, SMALL).endswith(f"run `{UPDATE}`.")
        assert "jaxlib 1.0 then, jaxlib 2.0 now" in advice(SMALL, replace(SMALL, versions="jaxlib 2.0"))


class TestFile:
    def test_comes_back(self, tmp_path: Path) -> None:
        save_budget(tmp_path / "budget.json", SMALL)
        assert load_budget(tmp_path / "budget.json") == SMALL

    @pytest.mark.parametrize(
        ("content", "expected"),
        [(None, "cannot be read"), ("[", f"as `{UPDATE}` writes it"), ('{"machine": "x"}', "versions")],
    )
    def test_that_is_none(self, tmp_path: Path, content: str | None, expected: str) -> None:
        path = tmp_path / "budget.json"
        if content is not None:
            path.write_text(content)
        with pytest.raises(BenchmarkError, match=r"budget\.json") as problem:
            load_budget(path)
        assert expected in str(problem.value)
