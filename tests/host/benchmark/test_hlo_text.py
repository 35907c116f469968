"""Optimized HLO read: counts of a small program, and the functions that wrote it."""

from collections.abc import Callable, Iterator

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxlie import SE3
from jaxslam_kernels.se3 import rotation_matrix

from jaxslam.benchmark.compiling.hlo_text import (
    NO_FUNCTION,
    Count,
    count,
    count_by_function,
    module_name,
    read_instructions,
)
from jaxslam.geometry import se3

WRITTEN = """HloModule jit_small, is_scheduled=true, entry_computation_layout={(f32[3]{0})->f32[3]{0}}

FileNames
1 "/elsewhere/jaxslam/user.py"
2 "%OURS%"
3 "/site-packages/jax/_src/lax.py"

FunctionNames
1 "user"
2 "outer.<locals>.inner"
3 "add"

FileLocations
1 {file_name_id=1 function_name_id=1 line=1 end_line=1 column=1 end_column=2}
2 {file_name_id=2 function_name_id=2 line=1 end_line=1 column=1 end_column=2}
3 {file_name_id=3 function_name_id=3 line=1 end_line=1 column=1 end_column=2}

StackFrames
1 {file_location_id=1 parent_frame_id=1}
2 {file_location_id=2 parent_frame_id=1}
3 {file_location_id=3 parent_frame_id=2}

%fused_computation (param_0: f32[3]) -> f32[3] {
  %param_0 = f32[3]{0} parameter(0)
  %add.1 = f32[3]{0} add(%param_0, %param_0), metadata={op_name="add" stack_frame_id=3}
  ROOT %multiply.1 = f32[3]{0} multiply(%add.1, %add.1), metadata={op_name="mul" stack_frame_id=1}
}

ENTRY %main (x: f32[3]) -> (f32[3], f32[3]) {
  %x = f32[3]{0} parameter(0), metadata={op_name="x"}
  %fusion.1 = f32[3]{0} fusion(%x), kind=kLoop, calls=%fused_computation
  %copy.2 = f32[3]{0} copy(%fusion.1)
  %pair = (f32[3]{0}, /*index=1*/f32[3]{0}) custom-call(%copy.2), custom_call_target="two"
  ROOT %tuple = (f32[3]{0}, f32[3]{0}) tuple(%fusion.1, %copy.2)
}
"""


@pytest.fixture
def text() -> str:
    """A program as XLA prints it, of which one file is ours and another only looks so."""
    return WRITTEN.replace("%OURS%", se3.__file__)


def optimized(function: Callable[..., jax.Array], *arguments: np.ndarray) -> str:
    text = jax.jit(function).lower(*arguments).compile().as_text()
    assert text is not None
    return text


class TestWritten:
    def test_counts(self, text: str) -> None:
        """Parameters and the tuple compute nothing; what is inside the fusion is no kernel."""
        instructions = read_instructions(text)
        assert set(instructions) == {*("param_0", "add.1", "multiply.1", "x", "fusion.1", "copy.2", "pair", "tuple")}
        assert count(instructions.values()) == Count(5, 3)
        assert [name for name, one in instructions.items() if one.counts and one.is_kernel] == [
            "fusion.1", "copy.2", "pair"
        ]  # fmt: skip

    def test_functions(self, text: str) -> None:
        """The innermost one of ours, also of a fusion that does not say where it is from."""
        functions = {name: one.function for name, one in read_instructions(text).items()}
        ours = "geometry.se3.outer.inner"
        assert functions["add.1"] == functions["fusion.1"] == ours
        assert functions["multiply.1"] == functions["copy.2"] == functions["pair"] == NO_FUNCTION
        assert count_by_function(read_instructions(text).values()) == {NO_FUNCTION: Count(3, 2), ours: Count(2, 1)}

    def test_name(self, text: str) -> None:
        assert module_name(text) == "jit_small"


class TestCompiled:
    @pytest.fixture(autouse=True)
    def _cached_with_its_origin(self) -> Iterator[None]:
        """Without it the cache gives a program whose functions are those of another checkout that compiled the same.

        Other tests trace without locations.
        """
        settings = {"jax_compilation_cache_include_metadata_in_key": True, "jax_traceback_in_locations_limit": 100}
        before = {name: jax.config.values[name] for name in settings}
        for name, value in settings.items():
            jax.config.update(name, value)
        yield
        for name, value in before.items():
            jax.config.update(name, value)

    def test_one_addition(self) -> None:
        def plus_one(x: jax.Array) -> jax.Array:
            return x + jnp.float32(1)

        program = optimized(plus_one, np.zeros(1000, np.float32))
        counts = count(read_instructions(program).values())
        assert counts.kernels == 1
        assert module_name(program) == "jit_plus_one"
        assert "add" in [one.operation for one in read_instructions(program).values()]

    def test_a_loop_counts_what_is_in_it_once(self) -> None:
        def looped(times: int) -> Callable[[jax.Array], jax.Array]:
            return lambda x: jax.lax.fori_loop(0, times, lambda _, y: jnp.sin(y), x)

        few, many = (
            [one.operation for one in read_instructions(optimized(looped(times), np.zeros(8, np.float32))).values()]
            for times in (10, 1000)
        )
        assert few == many
        assert few.count("while") == few.count("sine") == 1

    def test_kernel_of_ours_is_named(self) -> None:
        """The sums in the rotation matrix are from there, and the sine around it from no function of ours."""
        pose = np.array([1, 0, 0, 0, 0, 0, 0], np.float32)
        program = optimized(lambda pose: jnp.sin(rotation_matrix(SE3(pose))), pose)
        instructions = read_instructions(program).values()
        assert {one.function for one in instructions if one.operation == "reduce"} == {"se3.rotation_matrix"}
        assert {one.function for one in instructions if one.operation == "sine"} == {NO_FUNCTION}
        counts = count_by_function(instructions)
        assert list(counts) == ["se3.rotation_matrix", NO_FUNCTION]
        assert sum(one.instructions for one in counts.values()) == count(instructions).instructions
