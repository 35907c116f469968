"""The synthetic recording on disk: every file of the TUM layout, read back without our own loaders and with them."""

from decimal import Decimal
from pathlib import Path

import cv2
import numpy as np
import pytest

from jaxslam.datasets import open_dataset
from jaxslam.datasets.synthetic import SyntheticConfig, SyntheticDataset, write_tum
from jaxslam.errors import DatasetError

FRAMES = 4


@pytest.fixture(scope="module")
def dataset() -> SyntheticDataset:
    return SyntheticDataset(SyntheticConfig(width=160, height=120, frames=FRAMES, people=2))


@pytest.fixture(scope="module")
def folder(dataset: SyntheticDataset, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("synthetic") / "recording"
    write_tum(dataset, folder)
    return folder


def rows(path: Path) -> list[list[str]]:
    return [line.split() for line in path.read_text().splitlines() if not line.startswith("#")]


def read(path: Path) -> np.ndarray:
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert image is not None, path
    return image


def test_images_come_back(dataset, folder):
    lists = {kind: rows(folder / f"{kind}.txt") for kind in ("rgb", "depth", "mask")}
    for index in range(FRAMES):
        frame = dataset.render(index)
        rgb, depth, mask = (read(folder / lists[kind][index][1]) for kind in ("rgb", "depth", "mask"))
        assert depth.dtype == np.uint16
        np.testing.assert_array_equal(rgb[..., ::-1], frame.rgb)
        np.testing.assert_allclose(depth / 5000.0, frame.depth_m, atol=1e-6)
        np.testing.assert_array_equal(mask, frame.instance_mask)


def test_lists_are_exact_in_time(dataset, folder):
    for kind in ("rgb", "depth", "mask"):
        listed = rows(folder / f"{kind}.txt")
        assert [int(Decimal(stamp) * 10**9) for stamp, _ in listed] == dataset.timestamps_ns.tolist()
        assert [name for _, name in listed] == [f"{kind}/{stamp}.png" for stamp, _ in listed]


def test_ground_truth_is_in_the_order_of_the_format(dataset, folder):
    table = np.loadtxt(folder / "groundtruth.txt")
    assert table.shape == (FRAMES, 8)
    np.testing.assert_allclose(table[:, 1:4], dataset.T_world_cam[:, 4:], atol=1e-8)
    np.testing.assert_allclose(table[:, 4:7], dataset.T_world_cam[:, 1:4], atol=1e-8)
    np.testing.assert_allclose(table[:, 7], dataset.T_world_cam[:, 0], atol=1e-8)


def test_our_loader_reads_it(dataset, folder):
    loaded = open_dataset(folder)
    assert len(loaded) == FRAMES
    np.testing.assert_array_equal(loaded.timestamps_ns, dataset.timestamps_ns)
    assert loaded.camera == dataset.camera
    for written, read in ((dataset[index], loaded[index]) for index in range(FRAMES)):
        np.testing.assert_array_equal(read.image, written.image)
        assert read.depth_m is not None
        assert written.depth_m is not None
        np.testing.assert_allclose(read.depth_m, written.depth_m, atol=1e-6)


def test_progress(dataset, tmp_path):
    calls = []
    write_tum(dataset, tmp_path, lambda done, total: calls.append((done, total)))
    assert calls == [(index + 1, FRAMES) for index in range(FRAMES)]
    assert (tmp_path / "rgb.txt").is_file()


def test_interrupted_write_leaves_no_recording(dataset, tmp_path):
    class StopError(Exception):
        pass

    def stop(done: int, total: int) -> None:
        raise StopError

    with pytest.raises(StopError):
        write_tum(dataset, tmp_path / "out", stop)
    assert not (tmp_path / "out").exists()
    assert not (tmp_path / "out.partial" / "rgb.txt").exists()
    write_tum(dataset, tmp_path / "out")
    assert len(list((tmp_path / "out" / "rgb").iterdir())) == FRAMES
    assert not (tmp_path / "out.partial").exists()


def test_folder_in_use_is_kept(dataset, tmp_path):
    (tmp_path / "precious.txt").write_text("mine")
    with pytest.raises(DatasetError, match="expected no such folder or an empty one"):
        write_tum(dataset, tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["precious.txt"]


def test_unwritable_place_is_named(dataset, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(DatasetError, match=r"file.*cannot be written"):
        write_tum(dataset, tmp_path / "file" / "out")
