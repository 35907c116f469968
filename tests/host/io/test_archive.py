"""Unpacking: all or nothing, and nothing outside, whatever the archive says."""

import errno
import gzip
import io
import stat
import tarfile
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from jaxslam.errors import DatasetError
from jaxslam.io import archive as module
from jaxslam.io.archive import unpack

FILES = {"walk/rgb.txt": b"color", "walk/depth.txt": b"depth", "walk/rgb/1.png": bytes(range(256)) * 500}


def tgz(path: Path, files: dict[str, bytes] = FILES, *more: tarfile.TarInfo) -> Path:
    with tarfile.open(path, "w:gz") as archive:
        for name, content in files.items():
            info = tarfile.TarInfo(name)
            info.size = len(content)
            archive.addfile(info, io.BytesIO(content))
        for info in more:
            archive.addfile(info)
    return path


def zipped(path: Path, files: dict[str, bytes] = FILES) -> Path:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in files.items():
            archive.writestr(name, content)
    return path


MAKERS = [pytest.param(tgz, id="tgz"), pytest.param(zipped, id="zip")]
Maker = Callable[..., Path]


@pytest.fixture
def target(tmp_path: Path) -> Path:
    return tmp_path / "recordings" / "walk"


def contents(folder: Path) -> dict[str, bytes]:
    return {f"walk/{p.relative_to(folder).as_posix()}": p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def refused(archive: Path, target: Path, expected: str, **settings: Any) -> None:
    """It must fail, name the archive, and leave nothing behind."""
    around = set(target.parent.parent.rglob("*")) | {target.parent}
    with pytest.raises(DatasetError) as error:
        unpack(archive, target, **settings)
    assert expected in str(error.value)
    assert archive.name in str(error.value) or str(target) in str(error.value)
    assert "\n" not in str(error.value)
    assert set(target.parent.parent.rglob("*")) <= around


class TestWhole:
    @pytest.mark.parametrize("make", MAKERS)
    def test_plain(self, tmp_path: Path, target: Path, make: Maker) -> None:
        told: list[tuple[int, int]] = []
        archive = make(tmp_path / "a")
        unpack(archive, target, holds=("rgb.txt", "depth.txt"), progress=lambda *both: told.append(both))
        assert contents(target) == FILES
        assert [path.name for path in target.parent.iterdir()] == ["walk"]
        size = archive.stat().st_size
        assert told == sorted(told)
        assert (told[0], told[-1]) == ((0, size), (size, size))

    def test_folders_of_their_own(self, tmp_path: Path, target: Path) -> None:
        folders = [tarfile.TarInfo(name) for name in ("walk", "walk/mask/")]
        for info in folders:
            info.type, info.mode = tarfile.DIRTYPE, 0  # a folder that nobody could write into
        unpack(tgz(tmp_path / "a", FILES, *folders), target)
        assert contents(target) == FILES
        assert (target / "mask").is_dir()
        assert (target / "mask").stat().st_mode & stat.S_IRWXU == stat.S_IRWXU

    @pytest.mark.parametrize("make", MAKERS)
    @pytest.mark.parametrize("prefix", ["", "./", "other/"])
    def test_folder_of_another_name_or_none(self, tmp_path: Path, target: Path, make: Maker, prefix: str) -> None:
        files = {prefix + name.removeprefix("walk/"): content for name, content in FILES.items()}
        unpack(make(tmp_path / "a", files), target, holds=("rgb.txt",))
        assert contents(target) == FILES

    @pytest.mark.parametrize("make", MAKERS)
    def test_beside_what_other_systems_leave(self, tmp_path: Path, target: Path, make: Maker) -> None:
        unpack(make(tmp_path / "a", {"__MACOSX/walk/._rgb.txt": b"", ".DS_Store": b""} | FILES), target)
        assert contents(target) == FILES

    def test_after_a_killed_one(self, tmp_path: Path, target: Path) -> None:
        half = target.parent / ".walk.unpacking" / "walk"
        half.mkdir(parents=True)
        (half / "half.png").touch()
        unpack(tgz(tmp_path / "a"), target)
        assert contents(target) == FILES
        assert not half.exists()


class TestOutside:
    @pytest.mark.parametrize("make", MAKERS)
    @pytest.mark.parametrize(
        "name",
        [
            "../evil",
            "walk/../../evil",
            "/jaxslam_evil/file",
            "..\\evil",
            "C:\\evil",
            "C:evil",
            "walk/..\\evil",
        ],
    )
    def test_names(self, tmp_path: Path, target: Path, make: Maker, name: str) -> None:
        refused(make(tmp_path / "a", FILES | {name: b"evil"}), target, "expected files inside one folder, got")
        assert not Path("/jaxslam_evil").exists()

    @pytest.mark.parametrize("kind", [tarfile.SYMTYPE, tarfile.LNKTYPE, tarfile.FIFOTYPE, tarfile.CHRTYPE])
    @pytest.mark.parametrize("goal", ["/etc", "../../..", "rgb.txt"])
    def test_links_and_devices(self, tmp_path: Path, target: Path, kind: bytes, goal: str) -> None:
        link = tarfile.TarInfo("walk/link")
        link.type, link.linkname = kind, goal
        refused(tgz(tmp_path / "a", FILES, link), target, "files and folders only, got the link or device 'walk/link'")

    def test_link_in_a_zip(self, tmp_path: Path, target: Path) -> None:
        archive = zipped(tmp_path / "a")
        link = zipfile.ZipInfo("walk/link")
        link.external_attr = (stat.S_IFLNK | 0o777) << 16
        with zipfile.ZipFile(archive, "a") as more:
            more.writestr(link, "/etc")
        refused(archive, target, "files and folders only, got the link or device 'walk/link'")

    def test_link_where_it_grows(self, tmp_path: Path, target: Path) -> None:
        elsewhere = tmp_path / "elsewhere"
        elsewhere.mkdir()
        (elsewhere / "mine").touch()
        target.parent.mkdir()
        (target.parent / ".walk.unpacking").symlink_to(elsewhere)
        refused(tgz(tmp_path / "a"), target, "cannot be unpacked")
        assert [path.name for path in elsewhere.iterdir()] == ["mine"]


class TestTooLarge:
    @pytest.mark.parametrize("make", MAKERS)
    def test_more_than_allowed(self, tmp_path: Path, target: Path, make: Maker) -> None:
        archive = make(tmp_path / "a", FILES | {"walk/zeros": bytes(10**6)})
        assert archive.stat().st_size < 10**5
        refused(archive, target, "expected at most 0.001 GB when unpacked, got more", max_bytes=10**6)
        unpack(archive, target, max_bytes=1_200_000)

    def test_says_it_is_large(self, tmp_path: Path, target: Path) -> None:
        huge = tarfile.TarInfo("walk/huge")
        huge.size = 10**14
        with gzip.open(tmp_path / "a", "wb") as file:
            file.write(huge.tobuf())
        refused(tmp_path / "a", target, "expected at most 64 GB when unpacked, got more")

    def test_says_it_is_smaller_than_it_is(self, tmp_path: Path, target: Path) -> None:
        archive = zipped(tmp_path / "a", {"walk/zeros": bytes(10**6)})
        true, false = (10**6).to_bytes(4, "little"), (1000).to_bytes(4, "little")
        content = archive.read_bytes()
        assert content.count(true) == 2
        archive.write_bytes(content.replace(true, false))
        refused(archive, target, "", max_bytes=10**4)

    def test_zeros_behind_the_end(self, tmp_path: Path, target: Path) -> None:
        archive = tgz(tmp_path / "a")
        with gzip.open(archive, "ab") as file:
            file.write(bytes(10**7))
        refused(archive, target, "expected at most 0.001 GB", max_bytes=10**6)

    @pytest.mark.parametrize("make", MAKERS)
    def test_many_files(self, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, target: Path, make: Maker) -> None:
        budget = module._Budget
        monkeypatch.setattr(module, "_Budget", lambda whole, left: budget(whole, left, members=50))
        refused(make(tmp_path / "a", {f"walk/{n}": b"" for n in range(60)}), target, "files, got more")


class TestDamaged:
    @pytest.mark.parametrize("make", MAKERS)
    @pytest.mark.parametrize("share", [0.3, 0.9, 0.999])
    def test_cut(self, tmp_path: Path, target: Path, make: Maker, share: float) -> None:
        archive = make(tmp_path / "a")
        whole = archive.read_bytes()
        archive.write_bytes(whole[: int(share * len(whole))])
        refused(archive, target, "damaged")

    @pytest.mark.parametrize("make", MAKERS)
    def test_one_bit(self, tmp_path: Path, target: Path, make: Maker) -> None:
        """Wherever it flips, what comes out is right or nothing does."""
        archive = make(tmp_path / "a")
        whole = archive.read_bytes()
        found = 0
        for place in range(10, len(whole), 7):
            archive.write_bytes(whole[:place] + bytes([whole[place] ^ 4]) + whole[place + 1 :])
            try:
                unpack(archive, target.with_name(f"walk{place}"), holds=("rgb.txt", "depth.txt"))
            except DatasetError:
                found += 1
            else:
                got = set(contents(target.with_name(f"walk{place}")).values())
                assert got == set(FILES.values())
        assert found > 0
        assert not list(target.parent.glob(".*"))

    def test_checksum_at_the_end(self, tmp_path: Path, target: Path) -> None:
        archive = tgz(tmp_path / "a")
        whole = bytearray(archive.read_bytes())
        whole[-8] ^= 1
        archive.write_bytes(whole)
        refused(archive, target, "damaged")

    @pytest.mark.parametrize("content", [b"", b"<html>not found</html>", b"PK", b"\x1f\x8b"])
    def test_something_else(self, tmp_path: Path, target: Path, content: bytes) -> None:
        (tmp_path / "a").write_bytes(content)
        refused(tmp_path / "a", target, "a: ")

    def test_missing(self, tmp_path: Path, target: Path) -> None:
        refused(tmp_path / "nowhere", target, "cannot be unpacked")

    @pytest.mark.parametrize("make", MAKERS)
    def test_another_one(self, tmp_path: Path, target: Path, make: Maker) -> None:
        archive = make(tmp_path / "a", {"walk/rgb.txt": b""})
        refused(archive, target, "got one without depth.txt", holds=("rgb.txt", "depth.txt"))

    @pytest.mark.filterwarnings("ignore:Duplicate name")
    def test_twice_the_same(self, tmp_path: Path, target: Path) -> None:
        with zipfile.ZipFile(tmp_path / "a", "w") as archive:
            archive.writestr("walk/rgb.txt", b"one")
            archive.writestr("walk/rgb.txt", b"two")
        refused(tmp_path / "a", target, "expected every file once, got 'walk/rgb.txt' twice")

    def test_password(self, tmp_path: Path, target: Path) -> None:
        archive = zipped(tmp_path / "a", {"walk/rgb.txt": b"color"})
        content = bytearray(archive.read_bytes())
        content[content.index(b"PK\x01\x02") + 8] |= 1
        archive.write_bytes(content)
        refused(archive, target, "without a password")

    def test_odd_compression(self, tmp_path: Path, target: Path) -> None:
        with zipfile.ZipFile(tmp_path / "a", "w", zipfile.ZIP_LZMA) as archive:
            archive.writestr("walk/rgb.txt", b"color")
        refused(tmp_path / "a", target, "expected the usual compression")


class TestStopped:
    @pytest.mark.parametrize("make", MAKERS)
    def test_interrupted(self, tmp_path: Path, target: Path, make: Maker) -> None:
        def stop(done: int, _: int) -> None:
            if done:
                raise KeyboardInterrupt

        with pytest.raises(KeyboardInterrupt):
            unpack(make(tmp_path / "a"), target, progress=stop)
        assert list(target.parent.iterdir()) == []
        unpack(tmp_path / "a", target)
        assert contents(target) == FILES

    def test_disk_full(self, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, target: Path) -> None:
        def full(*_: Any, **__: Any) -> None:
            raise OSError(errno.ENOSPC, "No space left on device")

        archive = tgz(tmp_path / "a")
        monkeypatch.setattr(tarfile, "copyfileobj", full)
        refused(archive, target, "cannot be unpacked: [Errno 28] No space left on device")

    def test_already_there(self, tmp_path: Path, target: Path) -> None:
        target.mkdir(parents=True)
        with pytest.raises(DatasetError, match="walk: expected nothing there"):
            unpack(tgz(tmp_path / "a"), target)

    def test_unwritable(self, tmp_path: Path) -> None:
        (tmp_path / "file").touch()
        with pytest.raises(DatasetError, match="cannot be unpacked"):
            unpack(tgz(tmp_path / "a"), tmp_path / "file" / "walk")
