"""Suites: what is in their files, what is wrong with them, and the runs they come to."""

import json
from dataclasses import replace
from pathlib import Path

import pytest

from jaxslam.benchmark.suites.job import Job
from jaxslam.benchmark.suites.opened_clip import opened
from jaxslam.benchmark.suites.plan import fingerprint, missing, plan, plan_differences, replaced_settings, swept
from jaxslam.benchmark.suites.suite import Sequence, checked_presets, load_suite, suites
from jaxslam.datasets.catalog import known_recordings
from jaxslam.datasets.synthetic import SyntheticConfig
from jaxslam.errors import BenchmarkError

SUITE = """
about: two rooms
presets: [static, default]
runs: 3
set: [semantics.model=null]
sequences:
  - name: room
    room: {frames: 5, people: 1}
  - recording: rgbd_bonn_crowd
    name: start
    stop: 20
"""


def suite_file(folder: Path, text: str) -> str:
    path = folder / "mine.yaml"
    path.write_text(text)
    return str(path)


class TestSuite:
    @pytest.mark.parametrize("name", suites())
    def test_that_comes_with_jaxslam(self, name: str) -> None:
        suite = load_suite(name)
        assert suite.about
        assert plan(suite)

    @pytest.mark.parametrize(("name", "rooms", "runs"), [("unknown_movers", 16, 128), ("seated", 4, 48)])
    def test_of_rooms_with_true_masks(self, name: str, rooms: int, runs: int) -> None:
        """All four paths, the same rooms for both kinds of masks, and a run of each."""
        suite = load_suite(name)
        assert len(suite.sequences) == rooms
        assert len(plan(suite)) == runs
        assert all(clip.room is not None and clip.room.frames == 120 for clip in suite.sequences)
        paths = [clip.room.path for clip in suite.sequences if clip.room is not None]
        assert {path: paths.count(path) for path in paths} == dict.fromkeys(
            ("xyz", "rpy", "halfsphere", "static"), rooms // 4
        )
        semantics = [(job.variant, job.config.semantics) for job in plan(suite) if job.variant]
        assert len({(variant, chosen.model) for variant, chosen in semantics}) == 2
        (labels,) = {
            chosen.labels for variant, chosen in semantics if (variant, chosen.model) == ("true-masks", "scene")
        }
        assert labels == (("person", "box") if name == "unknown_movers" else ("person",))

    def test_of_a_file(self, tmp_path: Path) -> None:
        suite = load_suite(suite_file(tmp_path, SUITE))
        assert (suite.name, suite.about, suite.presets, suite.runs) == ("mine", "two rooms", ("static", "default"), 3)
        assert suite.sequences[0] == Sequence("room", room=SyntheticConfig(frames=5, people=1))
        assert suite.sequences[1] == Sequence("start", "rgbd_bonn_crowd", stop=20)
        assert [clip.whole for clip in suite.sequences] == [True, False]

    @pytest.mark.slow
    def test_room_as_pairs(self, tmp_path: Path) -> None:
        text = "sequences: [{name: room, sensor: stereo, room: {frames: 1, people: 0, baseline_m: 0.1}}]"
        (job,) = plan(load_suite(suite_file(tmp_path, text)))
        dataset = opened(Job.of_json(job.to_json()).clip, None).dataset
        assert dataset.camera.is_stereo
        assert dataset[0].right is not None

    def test_camera_file_beside_it(self, tmp_path: Path) -> None:
        """It is found from wherever the suite is run; a known camera is left as it is."""
        (tmp_path / "mine_camera.yaml").touch()
        text = SUITE + "    camera: mine_camera.yaml\n  - recording: other\n    camera: tum_fr1\n"
        _, first, second = load_suite(suite_file(tmp_path, text)).sequences
        assert (first.camera, second.camera) == (str(tmp_path / "mine_camera.yaml"), "tum_fr1")

    def test_of_a_folder(self, tmp_path: Path) -> None:
        for name in ("b", "a"):
            (tmp_path / "some" / name).mkdir(parents=True)
            (tmp_path / "some" / name / "rgb.txt").touch()
        (tmp_path / "some" / "sequences" / "04").mkdir(parents=True)
        (tmp_path / "some" / "sequences" / "04" / "times.txt").touch()
        suite = load_suite(str(tmp_path))
        assert [clip.recording for clip in suite.sequences] == ["a", "b", "kitti_04"]

    @pytest.mark.parametrize(
        ("text", "what"),
        [
            ("sequences: []", "sequences: expected a list of at least one"),
            (SUITE + "seqences: []", "unknown key 'seqences' .did you mean 'sequences'"),
            (SUITE + "ablation: 3", "ablation: expected true or false, got 3"),
            (SUITE.replace("runs: 3", "runs: 0"), "runs: expected an integer >= 1 or null, got 0"),
            (SUITE.replace("static, default", "statik"), "unknown preset 'statik' .did you mean 'static'"),
            (SUITE.replace("static, default", ""), "presets: expected at least one"),
            (
                SUITE.replace("frames: 5", "frame: 5"),
                r"sequences\[0\]: room: unknown key 'frame' .did you mean 'frames'",
            ),
            (SUITE.replace("    stop: 20", "    stop: -1"), "stop"),
            (SUITE.replace("name: start", "name: room"), "'room' is listed twice"),
            (SUITE.replace("name: start", "name: a/b"), "expected a name that can be a folder's"),
            (SUITE.replace("recording: rgbd_bonn_crowd\n", "name: x\n").replace("    name: start\n", ""), "either"),
            (SUITE.replace("    stop: 20", "    sensor: lidar"), "sensor: expected one of 'rgbd', 'stereo'"),
            (
                SUITE.replace("- name: room", "- name: room\n    sensor: stereo"),
                "expected a `room` with baseline_m for stereo",
            ),
            (SUITE.replace("semantics.model", "semantic.model"), "semantic: unknown key"),
            (
                SUITE.replace("model=null", "model=scene"),
                "expected rendered rooms or worlds, got the recording start",
            ),
            (SUITE.replace("[semantics.model=null]", "semantics"), "set: expected a list, each text, got 'semantics'"),
            (SUITE + "variants: [a]", "variants: expected `key: value` lines"),
            (SUITE + "variants: {a: [track.num_points=x]}", "num_points"),
            ("- 1", "expected `key: value` lines"),
        ],
    )
    def test_wrong(self, tmp_path: Path, text: str, what: str) -> None:
        with pytest.raises(BenchmarkError, match=what) as raised:
            load_suite(suite_file(tmp_path, text))
        assert "mine.yaml" in str(raised.value)

    def test_unknown(self, tmp_path: Path) -> None:
        with pytest.raises(BenchmarkError, match="did you mean 'smoke'"):
            load_suite("smok")
        with pytest.raises(BenchmarkError, match="expected a folder with recordings"):
            load_suite(str(tmp_path))


class TestMissing:
    def test_nothing(self, tmp_path: Path) -> None:
        assert missing(load_suite(suite_file(tmp_path, SUITE)), ["rgbd_bonn_crowd"]) == {}

    def test_recording(self, tmp_path: Path) -> None:
        why = missing(load_suite(suite_file(tmp_path, SUITE)), [])
        assert why == {"rgbd_bonn_crowd": "not there; to get it: jaxslam data get rgbd_bonn_crowd"}

    def test_stereo(self) -> None:
        """All of KITTI that has ground truth, and what of it is there is run."""
        suite = load_suite("kitti_stereo")
        names = [clip.recording for clip in suite.sequences]
        assert names == [recording.name for recording in known_recordings().values() if recording.kind == "kitti"]
        assert len(names) == 11
        assert set(missing(suite, ["kitti_06"])) == set(names) - {"kitti_06"}
        assert missing(suite, names) == {}


class TestPlan:
    def test_all_runs(self, tmp_path: Path) -> None:
        jobs = plan(load_suite(suite_file(tmp_path, SUITE)))
        assert len(jobs) == 2 * 2 * 3
        assert len({job.folder for job in jobs}) == len(jobs)
        assert str(jobs[-1].folder) == "start/default/2"
        assert all(job.settings == ("semantics.model=null",) for job in jobs)

    def test_chosen(self, tmp_path: Path) -> None:
        jobs = plan(load_suite(suite_file(tmp_path, SUITE)), presets=("ngd",), runs=1)
        assert [str(job.folder) for job in jobs] == ["room/ngd/0", "start/ngd/0"]

    def test_runs_of_one_sequence(self, tmp_path: Path) -> None:
        suite = load_suite(suite_file(tmp_path, SUITE))
        often = replace(suite, sequences=(replace(suite.sequences[0], runs=4), *suite.sequences[1:]), runs=2)
        jobs = plan(often, presets=("ngd",))
        assert [(job.clip.name, job.seed) for job in jobs] == [
            *(("room", n) for n in range(4)),
            ("start", 0),
            ("start", 1),
        ]
        planned = fingerprint(jobs)
        assert planned["runs"] == 2
        assert planned["sequences"]["room"]["runs"] == 4
        assert "runs" not in planned["sequences"]["start"]
        assert jobs[0] == plan(suite, presets=("ngd",))[0]  # the same run, to go on with
        assert len(plan(often, presets=("ngd",), runs=1)) == 2

    def test_sweep(self, tmp_path: Path) -> None:
        suite = swept(load_suite(suite_file(tmp_path, SUITE)), ["track.num_points=256,512", "run.prefetch_frames=2,3"])
        jobs = plan(suite, presets=("default",), runs=1)
        assert len(jobs) == 2 * 4
        assert jobs[1].label == "default@num_points=256,prefetch_frames=3"
        assert jobs[1].settings == ("semantics.model=null", "track.num_points=256", "run.prefetch_frames=3")

    def test_sweep_of_lists(self, tmp_path: Path) -> None:
        """Commas inside brackets or quotes are no other value."""
        suite = swept(load_suite(suite_file(tmp_path, SUITE)), ["dynamics.cues=[clusters,epipolar],[]"])
        jobs = plan(suite, presets=("default",), runs=1)[:2]
        assert [job.label for job in jobs] == ["default@cues=[clusters,epipolar]", "default@cues=[]"]
        assert [job.config.dynamics.cues for job in jobs] == [("clusters", "epipolar"), ()]

    def test_folders_of_labels(self, tmp_path: Path) -> None:
        """Never nested, and one for each; the label itself is as it was given."""
        models = "semantics.model=/some/path/a.onnx,/some/path_a.onnx," + "x" * 300
        suite = swept(load_suite(suite_file(tmp_path, SUITE)), [models])
        jobs = plan(suite, presets=("static",), runs=1)[:3]
        assert jobs[0].label == "static@model=/some/path/a.onnx"
        assert len({job.folder for job in jobs}) == 3
        for job in jobs:
            assert len(job.folder.parts) == 3
            (tmp_path / job.folder).mkdir(parents=True)

    def test_command_line_beats_the_suite(self, tmp_path: Path) -> None:
        """And its variants; what is replaced is told."""
        text = SUITE.replace("model=null]", "model=null, track.num_points=300]")
        suite = load_suite(suite_file(tmp_path, text + "variants: {few: [track.num_points=256]}\n"))
        given = ("track.num_points=200", "semantics.model=yolox-nano", "run.prefetch_frames=2")
        job = plan(suite, presets=("static",), runs=1, settings=given)[0]
        config = job.config
        assert (config.track.num_points, config.semantics.model) == (200, "yolox-nano")
        assert replaced_settings(suite, given) == [
            "track.num_points=200 from the command line replaces 300 of the suite",
            "track.num_points=200 from the command line replaces 256 of variant few",
            "semantics.model=yolox-nano from the command line replaces null of the suite",
        ]
        assert not replaced_settings(suite, ["semantics.min_score=0.5"])
        assert replaced_settings(suite, [], ["track.num_points=1,2"])[0].startswith("track.num_points=1,2 from")

    @pytest.mark.parametrize("sweep", ["track.num_points=1,2", "track={num_points: 1}"])
    def test_setting_that_is_swept_too(self, tmp_path: Path, sweep: str) -> None:
        suite = load_suite(suite_file(tmp_path, SUITE))
        with pytest.raises(BenchmarkError, match=r"--sweep: expected no setting that --set gives"):
            replaced_settings(suite, ["track.num_points=200"], [sweep])
        with pytest.raises(BenchmarkError, match=r"expected all values of track\.num_points in one"):
            swept(suite, ["track.num_points=1", "track.num_points=2"])

    def test_preset_twice_is_once(self, tmp_path: Path) -> None:
        assert checked_presets(("static", "ngd", "static")) == ("static", "ngd")
        suite = load_suite(suite_file(tmp_path, SUITE.replace("static, default", "static, static")))
        assert len(plan(suite, runs=1)) == 2

    @pytest.mark.parametrize("sweep", ["", "track.num_points", "track.num_points=", "=1,2", "track.num_points=1,,2"])
    def test_wrong_sweep(self, tmp_path: Path, sweep: str) -> None:
        with pytest.raises(BenchmarkError, match="--sweep: expected key=value,value"):
            swept(load_suite(suite_file(tmp_path, SUITE)), [sweep])

    def test_fingerprint(self, tmp_path: Path) -> None:
        """Plain, and the same but for what was changed, which is named."""
        suite = load_suite(suite_file(tmp_path, SUITE))
        found = fingerprint(plan(suite))
        assert json.loads(json.dumps(found)) == found == {
            "sequences": {
                "room": {"room": {"frames": 5, "people": 1}},
                "start": {"recording": "rgbd_bonn_crowd", "stop": 20},
            },
            "presets": {
                "static": {"preset": "static", "settings": ["semantics.model=null"]},
                "default": {"preset": "default", "settings": ["semantics.model=null"]},
            },
            "runs": 3,
        }  # fmt: skip
        assert not plan_differences(found, fingerprint(plan(suite)))
        longer = load_suite(suite_file(tmp_path, SUITE.replace("frames: 5", "frames: 7")))
        assert plan_differences(found, fingerprint(plan(longer, runs=2, settings=["run.prefetch_frames=2"]))) == [
            "sequences.room.room.frames: 5, now 7",
            "presets.static.settings: ['semantics.model=null'], now ['semantics.model=null', 'run.prefetch_frames=2']",
            "presets.default.settings: ['semantics.model=null'], now ['semantics.model=null', 'run.prefetch_frames=2']",
            "runs: 3, now 2",
        ]

    def test_job_as_text(self, tmp_path: Path) -> None:
        for job in plan(load_suite(suite_file(tmp_path, SUITE))):
            again = Job.of_json(job.to_json())
            assert again == job
            assert again.to_json() == job.to_json()
