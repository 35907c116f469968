"""Runs with true masks of a rendered room: the setting `semantics.model: scene`."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
from command_line import failing
from small_scene import SETTINGS
from tiny_recording import CAMERA, write_recording

from jaxslam.benchmark.reports.markdown import without_network
from jaxslam.benchmark.suites.suite import load_suite
from jaxslam.cli.entry_point import main
from jaxslam.config.schema import SemanticsConfig
from jaxslam.datasets import Subset, open_dataset
from jaxslam.datasets.synthetic import SyntheticConfig, SyntheticDataset, with_true_masks
from jaxslam.errors import BenchmarkError, ConfigError
from jaxslam.masks.box_to_mask import mask_of_detections
from jaxslam.semantics.from_config import SCENE, detector_of, network_files, why_no_network

ROOM = SyntheticConfig(width=96, height=72, frames=6, people=1, boxes=1, seated=1)
TRUTH = SemanticsConfig(model=SCENE, labels=("person", "box"))
SUITE = f"""
presets: [static]
set: [{", ".join(SETTINGS)}, semantics.latency_frames=0, semantics.dilate_px=0]
variants:
  blind: [semantics.model=scene, "semantics.labels=[person]"]
  true-masks: [semantics.model=scene, "semantics.labels=[person, box]"]
sequences:
  - name: room
    room: {{frames: 6, people: 0, boxes: 1, width: 160, height: 120}}
"""

fails = failing()


@pytest.fixture(scope="module")
def room() -> SyntheticDataset:
    return SyntheticDataset(ROOM)


class TestWithTrueMasks:
    def test_frames_and_what_moves_in_them(self, room: SyntheticDataset) -> None:
        dataset, detector = with_true_masks(room, TRUTH)
        assert detector is not None
        assert (dataset.name, dataset.camera, len(dataset)) == (room.name, room.camera, len(room))
        assert dataset.ground_truth is room.ground_truth
        np.testing.assert_array_equal(dataset.timestamps_ns, room.timestamps_ns)
        for index in (3, 0, -1):
            frame, true = dataset[index], room.render(index)
            np.testing.assert_array_equal(frame.image, true.rgb)
            np.testing.assert_array_equal(frame.depth_m, true.depth_m)
            assert frame.dynamic_mask is None
            mask = mask_of_detections(detector(frame.image), true.depth_m, room.camera.fx, dilate_px=0)
            np.testing.assert_array_equal(mask, true.instance_mask > 0)
        with pytest.raises(IndexError):
            dataset[len(room)]

    def test_blind_to_boxes(self, room: SyntheticDataset) -> None:
        dataset, detector = with_true_masks(room, dataclasses.replace(TRUTH, labels=("person",)))
        assert detector is not None
        true = room.render(2)
        mask = mask_of_detections(detector(dataset[2].image), true.depth_m, room.camera.fx, dilate_px=0)
        np.testing.assert_array_equal(mask, np.isin(true.instance_mask, (1, 3)))
        assert (true.instance_mask == 2).any()

    def test_every_frame_is_rendered_once(self, room: SyntheticDataset, monkeypatch: pytest.MonkeyPatch) -> None:
        rendered: list[int] = []
        render = SyntheticDataset.render
        monkeypatch.setattr(SyntheticDataset, "render", lambda room, i: (rendered.append(i), render(room, i))[1])
        dataset, detector = with_true_masks(Subset(room, 1, 6, 2), TRUTH)
        assert detector is not None
        images = [dataset[index].image for index in range(len(dataset))]
        for image in images:
            detector(image)
        assert rendered == [1, 3, 5]

    @pytest.mark.parametrize("model", [None, "yolox-nano"])
    def test_any_other_model(self, room: SyntheticDataset, model: str | None) -> None:
        dataset, detector = with_true_masks(room, SemanticsConfig(model=model))
        assert dataset is room
        assert detector is None

    @pytest.mark.parametrize("part", [False, True])
    def test_recording_has_no_truth(self, tmp_path: Path, part: bool) -> None:
        dataset = open_dataset(write_recording(tmp_path / "walk"), camera=CAMERA)
        name = "walk"
        if part:
            dataset, name = Subset(dataset, 1, 3), r"walk\[1:3\]"
        with pytest.raises(
            ConfigError, match=f"semantics.model: 'scene' expected a rendered room or world, got .* {name}$"
        ):
            with_true_masks(dataset, TRUTH)

    def test_unknown_label(self, room: SyntheticDataset) -> None:
        with pytest.raises(ConfigError, match=r"labels: expected classes .*got 'cart'"):
            with_true_masks(room, dataclasses.replace(TRUTH, labels=("cart",)))

    @pytest.mark.parametrize("key", ["prompt_encoder", "prompt_decoder", "examples"])
    def test_nothing_is_prompted_for(self, room: SyntheticDataset, key: str) -> None:
        with pytest.raises(ConfigError, match=f"semantics.{key}: expected null with semantics.model=scene, got 'x'"):
            with_true_masks(room, dataclasses.replace(TRUTH, **{key: "x"}))


class TestNoNetwork:
    def test_is_no_file(self) -> None:
        assert network_files(TRUTH) == {}
        assert why_no_network(TRUTH) is None

    def test_is_no_detector_without_a_room(self, room: SyntheticDataset) -> None:
        with pytest.raises(ConfigError, match=r"semantics.model: expected a network, got 'scene'"):
            detector_of(TRUTH)

    def test_recording_on_the_command_line(self, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
        folder = str(write_recording(tmp_path / "walk"))
        expected = "semantics.model: expected a network, got 'scene', which knows rendered rooms only"
        arguments = ("--camera", "tum_fr1", "--out", str(tmp_path / "out"), "--set", "semantics.model=scene")
        assert fails(capsys, "run", folder, *arguments) == expected


@pytest.mark.slow
class TestSuite:
    def test_recording_in_it(self, tmp_path: Path) -> None:
        path = tmp_path / "mine.yaml"
        path.write_text(SUITE + "  - recording: rgbd_bonn_crowd\n")
        with pytest.raises(
            BenchmarkError, match="'scene' expected rendered rooms or worlds, got the recording rgbd_bonn_crowd"
        ):
            load_suite(str(path))

    def test_runs(self, tmp_path: Path) -> None:
        """The box is masked where it is known, and nobody claims that a network was missing."""
        path = tmp_path / "mine.yaml"
        path.write_text(SUITE)
        main(["bench", str(path), "--out", str(tmp_path / "out")])
        results = {run["variant"]: run for run in json.loads((tmp_path / "out" / "results.json").read_text())}
        assert results.keys() == {"blind", "true-masks"}
        for run in results.values():
            assert (run["status"], run["model"], run["tracked"]) == ("done", SCENE, 6)
        assert results["blind"]["mask_age_frames"] is None
        assert results["true-masks"]["mask_age_frames"]["max"] == 0
        found = {path.parents[1].name for path in (tmp_path / "out").rglob("masks.png")}
        assert found == {"static@true-masks"}
        assert not without_network(list(results.values()))
        assert "without a network" not in (tmp_path / "out" / "report.md").read_text()


@pytest.mark.slow
def test_demo(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    small = ["--frames", "3", "--people", "0", "--boxes", "1", "--seated", "1", "--out", str(tmp_path)]
    main(["demo", *small, "--set", "semantics.model=scene", "--set", "semantics.labels=[person, box]", "--json"])
    out, err = capsys.readouterr()
    assert "0 people, 1 boxes carried about, 1 people at the desk" in " ".join(err.split())
    assert "model: scene" in (tmp_path / "config.yaml").read_text()
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert json.loads(out) == summary
    assert summary["tracked"] == 3
    assert "0people_1boxes_1seated" in summary["dataset"]
