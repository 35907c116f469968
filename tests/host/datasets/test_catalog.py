"""The catalog of public recordings, and finding their folders on this machine."""

import os
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from jaxslam.datasets import catalog as module
from jaxslam.datasets.catalog import find_recording, found_recordings, known_recording, known_recordings, recordings_dir
from jaxslam.datasets.loaders import tum
from jaxslam.errors import DatasetError
from jaxslam.sensors.camera import Camera

KNOWN = known_recordings()
ENTRY = """
- dataset: Ours
  kind: tum
  license: CC0
  page: https://example.org
  url: https://example.org/{name}.tgz
  recordings:
    walk:
      about: a walk
"""


@pytest.fixture(autouse=True)
def cache(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """The cache folder for recordings, empty; no folder of the user's."""
    monkeypatch.delenv("JAXSLAM_DATA", raising=False)
    folder = tmp_path / "cache"
    monkeypatch.setattr(module, "platformdirs", SimpleNamespace(user_cache_dir=lambda *_, **__: str(folder)))
    (folder / "recordings").mkdir(parents=True)
    return folder / "recordings"


@pytest.fixture
def chosen(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """The folder that the user names."""
    folder = tmp_path / "chosen"
    folder.mkdir()
    monkeypatch.setenv("JAXSLAM_DATA", str(folder))
    return folder


def recording(folder: Path) -> Path:
    folder.mkdir(parents=True)
    (folder / "rgb.txt").touch()
    return folder


class TestCatalog:
    @pytest.mark.parametrize("name", KNOWN)
    def test_entry_is_complete(self, name: str) -> None:
        entry = KNOWN[name]
        assert entry.name == name
        assert entry.page.startswith("https://")
        assert entry.license
        assert bool(entry.url) != bool(entry.how)
        if entry.url is not None:
            assert entry.url.startswith("https://")
            assert entry.url.endswith("/" + entry.archive)
            assert entry.archive == name + {"tum": ".tgz", "bonn": ".zip"}[entry.kind]
        assert entry.sha256 is None or entry.size_bytes is not None

    def test_names_tell_kind_and_camera(self) -> None:
        for name, entry in KNOWN.items():
            if entry.kind == "tum":
                camera = tum.LOADER.camera(Path(name))
                assert isinstance(camera, Camera)
                assert f"/freiburg{camera.name[-1]}/" in (entry.url or "")
            else:
                assert name.startswith(
                    {"bonn": "rgbd_bonn_", "kitti": "kitti_", "euroc": ("MH_", "V1_", "V2_")}[entry.kind]
                )

    @pytest.mark.parametrize(
        "names",
        [
            [f"rgbd_dataset_freiburg3_walking_{path}" for path in ("xyz", "rpy", "halfsphere", "static")],
            [f"rgbd_dataset_freiburg3_sitting_{path}" for path in ("xyz", "rpy", "halfsphere", "static")],
            [f"rgbd_dataset_freiburg1_{path}" for path in ("xyz", "rpy", "desk", "room", "360")],
            [f"rgbd_dataset_freiburg{path}" for path in ("2_desk", "2_xyz", "3_long_office_household")],
            [f"rgbd_bonn_{what}{part}" for what in ("balloon", "person_tracking", "synchronous") for part in ("", "2")],
            [f"rgbd_bonn_crowd{part}" for part in ("", "2", "3")],
            [f"rgbd_bonn_moving_{kind}_box{part}" for kind in ("obstructing", "nonobstructing") for part in ("", "2")],
            [f"rgbd_bonn_{what}" for what in ("kidnapping_box", "kidnapping_box2", "static", "static_close_far")],
            [f"kitti_{number:02d}" for number in range(11)],
            ["MH_01_easy", "MH_05_difficult", "V1_03_difficult", "V2_02_medium", "V2_03_difficult"],
        ],
    )
    def test_holds_what_papers_use(self, names: list[str]) -> None:
        assert set(names) <= set(KNOWN)

    def test_licenses(self) -> None:
        assert {entry.kind: entry.license for entry in KNOWN.values()} == {
            "tum": "CC BY 4.0",
            "bonn": "see page",
            "kitti": "CC BY-NC-SA 3.0",
            "euroc": "see page",
        }

    @pytest.mark.parametrize(
        ("given", "meant"),
        [
            ("rgbd_dataset_freiburg3_walking_xzy", "rgbd_dataset_freiburg3_walking_xyz"),
            ("fr3_walking_xyz", "rgbd_dataset_freiburg3_walking_xyz"),
            ("fr3/walking_rpy", "rgbd_dataset_freiburg3_walking_rpy"),
            ("crowd2", "rgbd_bonn_crowd2"),
            ("bonn_crwod3", "rgbd_bonn_crowd3"),
        ],
    )
    def test_misspelt_or_short(self, given: str, meant: str) -> None:
        with pytest.raises(DatasetError) as error:
            known_recording(given)
        assert f"got '{given}' (did you mean '{meant}'?)" in str(error.value)

    def test_nothing_like_it(self) -> None:
        with pytest.raises(DatasetError, match="got 'zzz'; jaxslam data list prints them"):
            known_recording("zzz")


class TestCatalogFile:
    def read(self, tmp_path: Path, text: str) -> dict[str, module.Recording]:
        path = tmp_path / "recordings.yaml"
        path.write_text(text)
        return known_recordings(path)

    def test_good(self, tmp_path: Path) -> None:
        entry = self.read(tmp_path, ENTRY)["walk"]
        assert (entry.url, entry.archive, entry.size_bytes) == ("https://example.org/walk.tgz", "walk.tgz", None)

    @pytest.mark.parametrize(
        ("change", "expected"),
        [
            (
                ("about: a walk", "abuot: a walk"),
                "group 1: recordings: walk: unknown key 'abuot' (did you mean 'about'?)",
            ),
            (("  license: CC0\n", ""), "group 1: recordings: walk: missing 'license'"),
            (("kind: tum", "kind: tmu"), "walk: kind: expected"),
            (("about: a walk", "about: a walk\n      size_bytes: -1"), "walk: size_bytes: expected"),
            (("about: a walk", "about: a walk\n      size_bytes: many"), "walk: size_bytes: expected"),
            (("about: a walk", "about: a walk\n      sha256: abc"), "walk: sha256: expected 64"),
            (("{name}.tgz", "{name}.rar"), "walk: url: expected .tgz or .zip"),
            (("  url: https://example.org/{name}.tgz\n", ""), "walk: url: expected an address, or `how`"),
            (("    walk:", "    ../walk:"), "name: expected letters"),
            (("      about: a walk", "      - a walk"), "walk: expected `key: value` lines, got ['a walk']"),
            (("  recordings:", "  recording:"), "group 1: recordings: expected `key: value` lines"),
            ((ENTRY, "words"), "expected a list of groups, got str"),
            ((ENTRY, ENTRY + ENTRY), "walk: listed twice"),
            ((ENTRY, "a: ["), "not readable as YAML"),
        ],
    )
    def test_bad(self, tmp_path: Path, change: tuple[str, str], expected: str) -> None:
        with pytest.raises(DatasetError) as error:
            self.read(tmp_path, ENTRY.replace(*change))
        assert expected in str(error.value)
        assert str(error.value).startswith(str(tmp_path / "recordings.yaml"))

    def test_missing(self, tmp_path: Path) -> None:
        with pytest.raises(DatasetError, match=r"none\.yaml: cannot be read"):
            known_recordings(tmp_path / "none.yaml")


class TestFind:
    def test_nowhere(self) -> None:
        assert find_recording("walk") is None
        assert found_recordings() == {}

    def test_without_a_cache_folder(self, cache: Path) -> None:
        cache.rmdir()
        assert find_recording("walk") is None

    @pytest.mark.parametrize("below", ["", "a/", "a/b/"])
    def test_at_any_depth(self, chosen: Path, below: str) -> None:
        assert recording(chosen / f"{below}walk") == find_recording("walk")

    def test_not_deeper(self, chosen: Path) -> None:
        recording(chosen / "a/b/c/walk")
        assert find_recording("walk") is None

    def test_order(self, chosen: Path, cache: Path, tmp_path: Path) -> None:
        in_cache = recording(cache / "walk")
        assert find_recording("walk") == in_cache
        in_chosen = recording(chosen / "tum" / "walk")
        assert find_recording("walk") == in_chosen
        in_root = recording(tmp_path / "root" / "a" / "walk")
        assert find_recording("walk", tmp_path / "root") == in_root
        assert recording(tmp_path / "root" / "walk") == find_recording("walk", str(tmp_path / "root"))
        assert found_recordings() == {"walk": in_chosen}

    def test_folder_without_a_recording(self, chosen: Path) -> None:
        (chosen / "walk").mkdir()
        assert find_recording("walk") is None
        inner = recording(chosen / "walk" / "walk")  # as some programs unpack
        assert find_recording("walk") == inner

    def test_hidden_folders_and_the_inside_of_recordings_are_passed_over(self, chosen: Path) -> None:
        recording(chosen / ".walk.unpacking" / "walk")
        recording(recording(chosen / "run") / "walk")
        assert set(found_recordings()) == {"run"}

    def test_kitti(self, chosen: Path) -> None:
        folder = chosen / "kitti" / "sequences" / "05"
        folder.mkdir(parents=True)
        (folder / "times.txt").touch()
        assert find_recording("kitti_05") == folder
        assert find_recording("05") is None

    def test_through_a_link(self, chosen: Path, tmp_path: Path) -> None:
        recording(tmp_path / "disk" / "walk")
        (chosen / "disk").symlink_to(tmp_path / "disk")
        (chosen / "round").symlink_to(chosen)
        assert find_recording("walk") == chosen / "disk" / "walk"

    def test_folder_that_may_not_be_read(self, monkeypatch: pytest.MonkeyPatch, chosen: Path) -> None:
        mine = recording(chosen / "b" / "walk")
        recording(chosen / "a" / "walk")
        scandir = os.scandir

        def refuse(folder: Path) -> Any:
            if folder == chosen / "a":
                raise PermissionError
            return scandir(folder)

        monkeypatch.setattr(module.os, "scandir", refuse)
        assert find_recording("walk") == mine

    @pytest.mark.parametrize("what", ["file", "nowhere"])
    def test_no_folder(self, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, what: str) -> None:
        (tmp_path / "file").touch()
        with pytest.raises(DatasetError, match="root: expected a folder, got"):
            find_recording("walk", tmp_path / what)
        monkeypatch.setenv("JAXSLAM_DATA", str(tmp_path / what))
        with pytest.raises(DatasetError, match="JAXSLAM_DATA: expected a folder, got"):
            find_recording("walk")

    def test_unset_is_empty(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setenv("JAXSLAM_DATA", "")
        assert find_recording("walk") is None

    def test_real_folders(self, data_dir: Path) -> None:
        found = found_recordings(data_dir)
        assert found["rgbd_bonn_crowd"] == data_dir / "bonn" / "rgbd_bonn_crowd"
        assert found["kitti_06"] == data_dir / "kitti" / "sequences" / "06"

    def test_place_of_downloads(self, cache: Path) -> None:
        assert recordings_dir() == cache
