"""`jaxslam learn weights`: errors in one line. The page on the learned cue runs it."""

from pathlib import Path

import pytest
from command_line import failing

fails = failing("learn", "weights")


@pytest.mark.parametrize(
    ("recipe", "problem"),
    [
        (None, "recipe.yaml"),
        ("rooms: []\n", "rooms, held_out: expected at least one scene each"),
        ("room: []\n", "unknown key 'room'"),
    ],
)
def test_wrong_recipes(capsys: pytest.CaptureFixture[str], tmp_path: Path, recipe: str | None, problem: str) -> None:
    file = tmp_path / "recipe.yaml"
    if recipe is not None:
        file.write_text(recipe)
    assert problem in fails(capsys, str(tmp_path / "out.json"), "--recipe", str(file))
    assert not (tmp_path / "out.json").exists()
