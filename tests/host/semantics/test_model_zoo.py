"""The table of public networks, and finding their files on this machine."""

import re
from pathlib import Path

import pytest

from jaxslam.errors import ModelError
from jaxslam.semantics.model_zoo import DEFAULT_MODEL, find_model, is_known, known_model, known_models, local_file

pytestmark = pytest.mark.usefixtures("models_cache")


@pytest.fixture
def chosen(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """The folder that the user names."""
    folder = tmp_path / "chosen"
    folder.mkdir()
    monkeypatch.setenv("JAXSLAM_MODELS", str(folder))
    return folder


def touch(path: Path) -> Path:
    path.write_bytes(b"net")
    return path


class TestTable:
    @pytest.mark.parametrize("name", known_models())
    def test_entry_is_complete(self, name: str) -> None:
        model = known_models()[name]
        assert model.name == name
        assert model.file.endswith(".onnx")
        assert model.page.startswith("https://")
        assert bool(model.url) != bool(model.how)  # it is either published or to be made
        if model.url is not None:
            assert model.url.startswith("https://")
            assert model.url.endswith("/" + model.file) or model.file == f"{name}.onnx"
            assert model.url.endswith(".onnx")
            assert re.fullmatch(r"[0-9a-f]{64}", model.sha256 or "")

    def test_default_can_be_downloaded_and_used_freely(self) -> None:
        model = known_model(DEFAULT_MODEL)
        assert model.url is not None
        assert model.license == "Apache-2.0"

    def test_nothing_under_agpl_is_downloaded(self) -> None:
        restricted = [model for model in known_models().values() if model.license.startswith("AGPL")]
        assert restricted
        assert all(model.url is None and "AGPL-3.0" in model.how for model in restricted)

    def test_segmenters_come_in_pairs(self) -> None:
        pairs = {name.removesuffix("-encoder") for name in known_models() if name.endswith("-encoder")}
        assert pairs == {name.removesuffix("-decoder") for name in known_models() if name.endswith("-decoder")}
        for pair in pairs:
            encoder, decoder = (known_models()[f"{pair}-{part}"] for part in ("encoder", "decoder"))
            assert encoder.adapter == decoder.adapter
            assert decoder.name in encoder.about
            assert encoder.name in decoder.about

    def test_is_known(self) -> None:
        assert is_known(DEFAULT_MODEL)
        assert not is_known("yolox_nano.onnx")

    def test_misspelt_name(self) -> None:
        with pytest.raises(ModelError, match=r"got 'yolox-nan' \(did you mean 'yolox-nano'\?\)"):
            known_model("yolox-nan")


class TestFindModel:
    def test_a_file(self, tmp_path: Path) -> None:
        mine = touch(tmp_path / "mine.onnx")
        assert find_model(mine) == mine
        assert find_model(str(mine)) == mine

    @pytest.mark.parametrize("file", ["yolox_nano.onnx", "yolox-nano.onnx"])
    def test_in_the_cache(self, models_cache: Path, file: str) -> None:
        assert touch(models_cache / file) == find_model("yolox-nano")

    @pytest.mark.parametrize("file", ["yolox_nano.onnx", "yolox-nano.onnx"])
    def test_in_the_chosen_folder_first(self, models_cache: Path, chosen: Path, file: str) -> None:
        touch(models_cache / "yolox_nano.onnx")
        assert touch(chosen / file) == find_model("yolox-nano")

    @pytest.mark.usefixtures("chosen")
    def test_in_the_cache_if_not_in_the_chosen_folder(self, models_cache: Path) -> None:
        assert touch(models_cache / "yolox_nano.onnx") == find_model("yolox-nano")

    def test_default(self, models_cache: Path) -> None:
        assert touch(models_cache / known_model(DEFAULT_MODEL).file) == find_model()

    def test_folder_of_that_name_is_no_model(
        self, monkeypatch: pytest.MonkeyPatch, models_cache: Path, tmp_path: Path
    ) -> None:
        (tmp_path / "yolox-nano").mkdir()
        monkeypatch.chdir(tmp_path)
        assert touch(models_cache / "yolox_nano.onnx") == find_model("yolox-nano")

    def test_missing_says_how_to_get_it(self, models_cache: Path) -> None:
        with pytest.raises(ModelError) as error:
            find_model("yolox-nano")
        assert "jaxslam models get yolox-nano" in str(error.value)
        assert str(models_cache / "yolox_nano.onnx") in str(error.value)

    def test_missing_and_not_published_says_how_to_make_it(self, models_cache: Path) -> None:
        with pytest.raises(ModelError) as error:
            find_model("yolov8n")
        assert "yolo export model=yolov8n.pt format=onnx" in str(error.value)
        assert str(models_cache / "yolov8n.onnx") in str(error.value)
        assert "models get" not in str(error.value)

    @pytest.mark.parametrize("name", ["nowhere.onnx", "yolox-nan"])
    def test_neither_file_nor_name(self, name: str) -> None:
        with pytest.raises(ModelError, match=f"expected a model file or the name of a known model, got '{name}'"):
            find_model(name)

    def test_chosen_folder_that_is_none(self, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
        monkeypatch.setenv("JAXSLAM_MODELS", str(tmp_path / "nowhere"))
        with pytest.raises(ModelError, match="JAXSLAM_MODELS: expected a folder, got"):
            find_model("yolox-nano")

    def test_unset_is_empty(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setenv("JAXSLAM_MODELS", "")
        assert local_file(known_model("yolox-nano")) is None
