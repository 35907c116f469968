"""Settings: strict at any depth, in the order overrides, file, preset, defaults."""

import dataclasses
import math
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import pytest
import tyro
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxslam.config import loading as config_module
from jaxslam.config.loading import configs_dir, load_config, presets, to_yaml, updated
from jaxslam.config.schema import Config, RunConfig, TrackConfig
from jaxslam.config.validation import Range, ValidatedConfig, checked_value
from jaxslam.errors import ConfigError


@dataclass(frozen=True)
class Leaf(ValidatedConfig):
    gain: Annotated[float, Range(above=0, at_most=1)] = 0.5
    sizes: tuple[Annotated[int, Range(at_least=1)], ...] = (3, 5)


@dataclass(frozen=True)
class Branch(ValidatedConfig):
    leaf: Leaf = field(default_factory=Leaf)
    extra: Leaf | None = None
    mode: Literal["off", "fast", 3] = "off"
    corner: tuple[int, float] = (1, 2.0)
    label: str | None = None
    limit: Annotated[int | None, Range(below=10)] = None


@dataclass(frozen=True)
class Root(ValidatedConfig):
    branch: Branch = field(default_factory=Branch)
    enabled: bool = True


@pytest.fixture
def write(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[str, str], Path]:
    """Writes presets into a folder that takes the place of the real one."""
    folder = tmp_path / "configs" / "presets"
    folder.mkdir(parents=True)
    monkeypatch.setattr(config_module, "configs_dir", lambda: folder.parent)

    def write_preset(name: str, text: str) -> Path:
        path = folder / f"{name}.yaml"
        path.write_text(text)
        return path

    write_preset("default", "# nothing\n")
    return write_preset


class TestChecked:
    @pytest.mark.parametrize(
        ("hint", "value", "expected"),
        [
            (float, 3, 3.0),
            (int, 3, 3),
            (bool, False, False),
            (str, "off", "off"),
            (float | None, None, None),
            (int | str, "x", "x"),
            (tuple[int, ...], [], ()),
            (tuple[int, ...], [1, 2], (1, 2)),
            (tuple[int, float], (1, 2), (1, 2.0)),
            (Literal["off", 3], 3, 3),
            (Annotated[int, Range(at_least=0, below=2)], 1, 1),
        ],
    )
    def test_accepts(self, hint: Any, value: object, expected: object) -> None:
        got = checked_value(hint, value, "key")
        assert got == expected
        assert type(got) is type(expected)

    @pytest.mark.parametrize(
        ("hint", "value", "words"),
        [
            (int, 3.0, "an integer, got 3.0"),
            (int, True, "an integer, got True"),
            (float, "3", "a finite number, got '3'"),
            (float, math.nan, "a finite number, got nan"),
            (float, math.inf, "a finite number, got inf"),
            (float, 10**400, "a finite number, got 1000"),
            (bool, 1, "true or false, got 1"),
            (str, None, "text, got None"),
            (float | None, "no", "a finite number or null, got 'no'"),
            (tuple[int, ...], 3, "a list, each an integer, got 3"),
            (tuple[int, ...], [1, "2"], "a list, each an integer, got [1, '2']"),
            (tuple[int, float], [1], "a list of 2: an integer, a finite number, got [1]"),
            (Literal["off", 3], True, "one of 'off', 3, got True"),
            (Annotated[int, Range(at_least=0, below=2)], 2, "an integer >= 0 and < 2, got 2"),
            (Annotated[float, Range(above=0, at_most=1)], 0, "a finite number > 0 and <= 1, got 0"),
            (Leaf, 3, "a Leaf, got 3"),
        ],
    )
    def test_refuses(self, hint: Any, value: object, words: str) -> None:
        with pytest.raises(ConfigError) as error:
            checked_value(hint, value, "some.key")
        assert str(error.value).startswith(f"some.key: expected {words}")

    def test_is_checked_when_built_in_code(self) -> None:
        with pytest.raises(ConfigError, match=r"Leaf\.gain: expected a finite number > 0 and <= 1, got 2"):
            Leaf(gain=2)
        with pytest.raises(ConfigError, match=r"Leaf\.gain"):
            dataclasses.replace(Leaf(), gain=-1.0)

    def test_equal_settings_hash_equal(self) -> None:
        assert hash(Leaf(gain=1, sizes=[3, 5])) == hash(Leaf(gain=1.0))  # type: ignore[arg-type]

    def test_unknown_annotation_is_a_mistake_in_the_code(self) -> None:
        with pytest.raises(TypeError, match="no check"):
            checked_value(dict, {}, "key")


class TestUpdated:
    def test_changes_only_what_is_named(self) -> None:
        root = updated(Root(), {"branch": {"leaf": {"gain": 1}, "mode": 3}})
        assert root == Root(Branch(leaf=Leaf(gain=1.0), mode=3))

    def test_optional_section(self) -> None:
        given_one = updated(Root(), {"branch": {"extra": {"gain": 0.25}}})
        assert given_one.branch.extra == Leaf(gain=0.25)
        changed = updated(given_one, {"branch": {"extra": {"sizes": [1]}}})
        assert changed.branch.extra == Leaf(gain=0.25, sizes=(1,))

    def test_empty_section_changes_nothing(self) -> None:
        assert updated(Root(), {"branch": None}) == Root()

    @pytest.mark.parametrize(
        ("changes", "words"),
        [
            ({"brunch": {}}, "brunch: unknown key (did you mean 'branch'?)"),
            ({"branch": {"leave": {}}}, "branch.leave: unknown key (did you mean 'leaf'?)"),
            ({"branch": {"leaf": {"gian": 1}}}, "branch.leaf.gian: unknown key (did you mean 'gain'?)"),
            ({"branch": {"extra": {"zzz": 1}}}, "branch.extra.zzz: unknown key (valid: gain, sizes)"),
            ({"branch": {3: 1}}, "branch.3: unknown key"),
            ({"branch": {"leaf": 3}}, "branch.leaf: expected a Leaf, got 3"),
            (
                {"branch": {"leaf": {"gain": 0}}},
                "branch.leaf.gain: expected a finite number > 0 and <= 1, got 0",
            ),
            (
                {"branch": {"leaf": {"sizes": [3, 0]}}},
                "branch.leaf.sizes: expected a list, each an integer >= 1",
            ),
            ({"branch": {"limit": 10}}, "branch.limit: expected an integer or null < 10, got 10"),
        ],
    )
    def test_refuses(self, changes: dict[str, Any], words: str) -> None:
        with pytest.raises(ConfigError) as error:
            updated(Root(), changes)
        assert str(error.value).startswith(words)


class TestPrecedence:
    def test_defaults(self) -> None:
        assert load_config() == Config()

    def test_override_beats_file_beats_preset(self, write: Callable[[str, str], Path], tmp_path: Path) -> None:
        write("fast", "track: {num_points: 100}\nrun: {seed: 1, prefetch_frames: 2}\n")
        file = tmp_path / "mine.yaml"
        file.write_text("run:\n  seed: 2\n  prefetch_frames: 3\n")
        config = load_config("fast", file, ["run.prefetch_frames=5"])
        assert config == Config(TrackConfig(num_points=100), RunConfig(seed=2, prefetch_frames=5))

    def test_preset_inherits(self, write: Callable[[str, str], Path]) -> None:
        write("a", "run: {seed: 1, prefetch_frames: 7}\n")
        write("b", "inherit: a\nrun: {seed: 2}\n")
        write("c", "inherit: b\ntrack: {num_points: 64}\n")
        assert load_config("c") == Config(TrackConfig(num_points=64), RunConfig(seed=2, prefetch_frames=7))

    def test_file_inherits(self, write: Callable[[str, str], Path], tmp_path: Path) -> None:
        write("a", "run: {seed: 1, prefetch_frames: 7}\n")
        (tmp_path / "mine.yaml").write_text("inherit: a\nrun: {seed: 9}\n")
        assert load_config(file=tmp_path / "mine.yaml").run == RunConfig(seed=9, prefetch_frames=7)

    def test_later_override_wins(self) -> None:
        assert load_config(overrides=["run.seed=1", "run.seed=2"]).run.seed == 2

    def test_override_of_a_section(self) -> None:
        config = load_config(overrides=["run={seed: 5, deterministic: false}", "run.prefetch_frames=2"])
        assert config.run == RunConfig(deterministic=False, seed=5, prefetch_frames=2)


def schema_renamed() -> dict[str, str]:
    """The table of earlier names of settings."""
    return config_module._RENAMED


class TestRefusals:
    @pytest.mark.parametrize(
        ("override", "words"),
        [
            ("track.num_pionts=400", "override: track.num_pionts: unknown key (did you mean 'num_points'?)"),
            ("trak.num_points=400", "override: trak: unknown key (did you mean 'track'?)"),
            ("track.num_points.x=4", "override: track.num_points: expected an integer"),
            ("track.num_points=many", "override: track.num_points: expected an integer >= 32"),
            (
                "track.num_points=3",
                "override: track.num_points: expected an integer >= 32 and <= 4096, got 3",
            ),
            ("track.num_points=[1", "override track.num_points:1: not readable as YAML"),
            (
                "track.num_points",
                "override: expected key=value such as track.num_points=400, got 'track.num_points'",
            ),
            ("=400", "override: expected key=value"),
            ("run.deterministic=yes", "override: run.deterministic: expected true or false, got 'yes'"),
        ],
    )
    def test_override(self, override: str, words: str) -> None:
        with pytest.raises(ConfigError) as error:
            load_config(overrides=[override])
        assert str(error.value).startswith(words)

    def test_override_within_a_value(self) -> None:
        with pytest.raises(ConfigError, match="needs a section, but 'track' is set to 3"):
            load_config(overrides=["track=3", "track.num_points=400"])

    @pytest.mark.parametrize(("old", "new"), sorted(schema_renamed().items()))
    def test_old_key_names_the_new_one(self, old: str, new: str) -> None:
        with pytest.raises(ConfigError, match=rf"override: {old}: renamed, use {new}$"):
            load_config(overrides=[f"{old}=1"])
        section, key = new.split(".")
        assert hasattr(getattr(Config(), section), key)

    def test_file_is_named(self, tmp_path: Path) -> None:
        (tmp_path / "mine.yaml").write_text("run: {sed: 1}\n")
        with pytest.raises(ConfigError, match=r"mine\.yaml: run\.sed: unknown key \(did you mean 'seed'\?\)"):
            load_config(file=tmp_path / "mine.yaml")

    def test_missing_file(self, tmp_path: Path) -> None:
        with pytest.raises(ConfigError, match=r"none\.yaml: cannot be read"):
            load_config(file=tmp_path / "none.yaml")

    def test_unknown_preset(self) -> None:
        with pytest.raises(ConfigError, match=r"preset: expected a known preset, got 'defualt' \(did you mean 'def"):
            load_config("defualt")

    def test_preset_inherits_unknown(self, write: Callable[[str, str], Path]) -> None:
        write("a", "inherit: zzz\n")
        with pytest.raises(ConfigError, match=r"preset a: inherit: expected a known preset, got 'zzz'"):
            load_config("a")

    def test_preset_inherits_itself(self, write: Callable[[str, str], Path]) -> None:
        write("a", "inherit: b\n")
        write("b", "inherit: a\n")
        with pytest.raises(ConfigError, match="preset a: inherits itself: a -> b -> a"):
            load_config("a")

    def test_inherit_of_no_name(self, write: Callable[[str, str], Path]) -> None:
        write("a", "inherit: [default]\n")
        with pytest.raises(ConfigError, match=r"a\.yaml: inherit: expected the name of a preset, got \['default'\]"):
            load_config("a")


class TestYaml:
    @given(
        gain=st.floats(0, 1, exclude_min=True),
        sizes=st.lists(st.integers(1), max_size=4),
        mode=st.sampled_from(["off", "fast", 3]),
        label=st.none() | st.text(st.characters(codec="utf-8", exclude_categories=["Cc", "Cs"])),
        enabled=st.booleans(),
    )
    @settings(deadline=None, max_examples=50)
    def test_round_trip(self, gain: float, sizes: list[int], mode: Any, label: str | None, enabled: bool) -> None:
        leaf = Leaf(gain, tuple(sizes))
        root = Root(Branch(leaf, leaf if enabled else None, mode, (1, gain), label), enabled)
        changes = config_module.parse_yaml(to_yaml(root), "text", ConfigError)
        assert updated(Root(), changes) == root

    def test_file_round_trip(self, tmp_path: Path) -> None:
        config = load_config(overrides=["track.num_points=400", "run.deterministic=false", "run.seed=7"])
        (tmp_path / "effective.yaml").write_text(to_yaml(config))
        assert load_config(file=tmp_path / "effective.yaml") == config

    def test_is_plain_yaml(self) -> None:
        assert yaml.safe_load(to_yaml(Root()))["branch"]["leaf"] == {"gain": 0.5, "sizes": [3, 5]}


class TestConfigsFolder:
    @pytest.mark.parametrize("name", presets())
    def test_every_preset_loads(self, name: str) -> None:
        load_config(name)

    def test_every_key_of_the_defaults_is_documented_for_the_command_line(
        self, capsys: pytest.CaptureFixture[str]
    ) -> None:
        with pytest.raises(SystemExit):
            tyro.cli(Config, args=["--help"])
        text = " ".join(capsys.readouterr().out.split())
        assert "--track.num-points INT" in text
        assert "Seed of every random choice." in text

    def test_command_line_starts_from_a_loaded_config(self) -> None:
        start = load_config(overrides=["run.seed=3"])
        config = tyro.cli(Config, default=start, args=["--track.num-points", "400"])
        assert config == Config(TrackConfig(num_points=400), RunConfig(seed=3))

    def test_source_checkout(self) -> None:
        assert (configs_dir() / "presets" / "default.yaml").is_file()

    def test_installed_package(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        installed = tmp_path / "site-packages" / "jaxslam" / "_configs"
        installed.mkdir(parents=True)
        (tmp_path / "site-packages" / "configs").mkdir()
        monkeypatch.setattr(config_module, "__file__", str(installed.parent / "config" / "loading.py"))
        assert configs_dir() == installed

    def test_no_folder(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(config_module, "__file__", str(tmp_path / "jaxslam" / "config" / "loading.py"))
        with pytest.raises(ConfigError, match="configs: expected the folder _configs"):
            configs_dir()
