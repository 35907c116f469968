"""Presets built around a network, on a machine without it: refused, or marked in everything they leave behind."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
import tiny_models
from command_line import failing
from small_scene import HEIGHT, SETTINGS, WIDTH

from jaxslam.cli.entry_point import main
from jaxslam.config.loading import load_config, presets
from jaxslam.datasets.synthetic import SyntheticConfig, SyntheticDataset, write_tum
from jaxslam.errors import MissingModelError
from jaxslam.semantics import no_detections
from jaxslam.semantics.from_config import detector_of, preset_needs_network, why_no_network
from jaxslam.slam.slam import Slam

refused = failing(code=2)

NEEDED_BY = {
    *("ngd", "ngd-published", "ngd-detector", "ngd-propagation"),
    *("occlusion", "occlusion-published", "occlusion-masks"),
    *("usd", "usd-published", "usd-sam", "usd-segmentation"),
    *("rts", "rts-published", "rts-semantics", "rts-semantics-epipolar"),
    *("trs-published", "trs-semantics"),
}
pytestmark = pytest.mark.usefixtures("models_cache")
CUES = ["dynamics.new_surfaces=false", "dynamics.cues=[clusters]", "dynamics.balance_regions=true"]
"""Those of `default`: its small tracker is that of other tests."""


ROOM = SyntheticDataset(SyntheticConfig(width=WIDTH, height=HEIGHT, frames=3, people=0))


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("recordings") / "room"
    write_tum(ROOM, folder)
    return folder


class TestPresets:
    @pytest.mark.parametrize("preset", presets())
    def test_that_need_a_network(self, preset: str) -> None:
        """The preset says whether it does; without one, it is an error to build its detector."""
        semantics = load_config(preset).semantics
        assert preset_needs_network(preset) == (preset in NEEDED_BY)
        if preset not in NEEDED_BY:
            assert detector_of(semantics) is None
            return
        first = semantics.prompt_encoder or "yolox-nano"
        with pytest.raises(MissingModelError, match=f"to download it: jaxslam models get {first}"):
            detector_of(semantics)
        assert detector_of(replace(semantics, missing_model="allow")) is None
        assert detector_of(replace(semantics, model=None, prompt_encoder=None, prompt_decoder=None)) is None

    def test_another_network_than_the_default_is_needed(self) -> None:
        """Whoever names one wants it."""
        with pytest.raises(MissingModelError, match=r"semantics.model: yolox-tiny is not on this machine"):
            detector_of(load_config(overrides=["semantics.model=yolox-tiny"]).semantics)

    @pytest.mark.parametrize(
        ("overrides", "why"),
        [
            ((), "yolox-nano not on this machine"),
            (("semantics.model=null",), "semantics.model is null"),
            (("semantics.model=yolox-tiny", "semantics.missing_model=allow"), "yolox-tiny not on this machine"),
        ],
    )
    def test_why_there_is_none(self, overrides: tuple[str, ...], why: str) -> None:
        assert why_no_network(load_config(overrides=overrides).semantics) == why


class TestSlam:
    def test_refuses(self) -> None:
        with pytest.raises(MissingModelError, match=r"semantics.missing_model=allow"):
            Slam(ROOM.camera, load_config("ngd"))

    def test_takes_a_detector_instead(self) -> None:
        """A function of the user's own is as good as the network."""
        with Slam(ROOM.camera, load_config("ngd"), detector=lambda image: no_detections()) as slam:
            assert slam.without_network is None
            assert slam.networks == {}

    def test_names_the_files(self, tmp_path: Path) -> None:
        """Masks are from depth where the segmenter is missing, and what is there is told."""
        path = tiny_models.yolox(tmp_path / "net.onnx", [])
        settings = [f"semantics.model={path}", "semantics.missing_model=allow"]
        with Slam(ROOM.camera, load_config("usd-sam", overrides=settings)) as slam:
            assert slam.networks == {"model": path, "prompt_encoder": None, "prompt_decoder": None}
            assert slam.without_network is None

    def test_says_so(self, caplog: pytest.LogCaptureFixture) -> None:
        with Slam(ROOM.camera, load_config("ngd", overrides=["semantics.missing_model=allow"])) as slam:
            assert slam.without_network == "yolox-nano not on this machine"
        assert "jaxslam models get yolox-nano" in caplog.text


class TestCommands:
    @pytest.mark.parametrize("command", [("run", "--preset"), ("compare", "--presets")])
    def test_refuse(
        self, recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], command: tuple[str, str]
    ) -> None:
        """One line with the command that gets the network, code 2, and no folder of results."""
        line = refused(capsys, command[0], str(recording), command[1], "ngd", "--out", str(tmp_path / "out"))
        assert "to download it: jaxslam models get yolox-nano" in line
        assert "--allow-missing-model" in line
        assert not (tmp_path / "out").exists()

    def test_go_on_if_allowed(self, recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
        chosen = ["--preset", "ngd", "--allow-missing-model", "--set", *SETTINGS, *CUES]
        main(["run", str(recording), "--out", str(tmp_path), *chosen])
        summary = json.loads((tmp_path / "summary.json").read_text())
        assert (summary["model"], summary["without_network"]) == ("yolox-nano", "yolox-nano not on this machine")
        assert summary["networks"] == {"model": None}
        out = capsys.readouterr().out
        assert "yolox-nano not on this machine" in out
        assert "…" not in out
        assert all(len(line) <= 80 for line in out.splitlines() if line.startswith("  "))
