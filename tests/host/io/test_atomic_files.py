"""Files are written whole or not at all, and nothing is left behind."""

import os
import resource
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from jaxslam.errors import MapFileError
from jaxslam.io.atomic_files import check_writable, make_folder, replacing, write_atomically


def left_behind(path: Path, process: int | None = None) -> Path:
    """What a process that was killed leaves beside a file."""
    if process is None:
        with subprocess.Popen([sys.executable, "-c", ""]) as ended:
            process = ended.pid
    temporary = path.with_name(f".{path.name}.{process}@{os.uname().nodename}.tmp")
    temporary.write_bytes(b"half")
    return temporary


class TestReplacing:
    def test_removes_what_killed_processes_left(self, tmp_path: Path) -> None:
        """Of this file; a process that still runs keeps its own, and so does one of another machine."""
        path = tmp_path / "a.map"
        left = left_behind(path)
        others = [left_behind(path, 1), left_behind(tmp_path / "b.map"), tmp_path / ".a.map.7@elsewhere.tmp"]
        others[-1].write_bytes(b"half")
        write_atomically(path, b"new")
        assert not left.exists()
        assert sorted(tmp_path.iterdir()) == sorted([path, *others])
        assert path.read_bytes() == b"new"

    def test_is_on_the_disk_before_it_has_its_name(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        done: list[tuple[str, str]] = []
        flush, replace = os.fsync, os.replace
        monkeypatch.setattr(
            os, "fsync", lambda file: (done.append(("flush", os.readlink(f"/proc/self/fd/{file}"))), flush(file))
        )
        monkeypatch.setattr(os, "replace", lambda old, new: (done.append(("move", str(old))), replace(old, new)))
        write_atomically(tmp_path / "a.map", b"new")
        (flushed, temporary), (moved, again), last = done
        assert (flushed, moved, temporary) == ("flush", "move", again)
        assert last == ("flush", str(tmp_path))

    @pytest.mark.parametrize("there", [True, False])
    def test_follows_links(self, tmp_path: Path, there: bool) -> None:
        real, first, second = tmp_path / "folder" / "real.map", tmp_path / "first", tmp_path / "second"
        real.parent.mkdir()
        if there:
            real.write_bytes(b"old")
        first.symlink_to("second")
        second.symlink_to("folder/real.map")
        write_atomically(first, b"new")
        assert first.is_symlink()
        assert second.is_symlink()
        assert real.read_bytes() == b"new"
        assert len(list(tmp_path.rglob("*"))) == 4

    @pytest.mark.parametrize(
        ("path", "words"),
        [
            ("", "'': cannot be written: expected the path of a file"),
            ("a\0b", r"'a\\x00b': cannot be written: expected the path of a file"),
            (".", r"\.: cannot be written: expected a file, got a folder"),
            ("no/", "expected a file, got the path of a folder"),
            ("no/a.map", "no/a.map: cannot be written: No such file or directory"),
            ("pipe", "pipe: cannot be written: expected a file, got a device, pipe or socket"),
            ("/dev/null", "/dev/null: cannot be written: expected a file, got a device, pipe or socket"),
            ("circle", "circle: cannot be written: Too many levels"),
            ("a" * 250, "cannot be written: File name too long"),
        ],
    )
    def test_refuses(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, path: str, words: str) -> None:
        monkeypatch.chdir(tmp_path)
        os.mkfifo("pipe")
        Path("circle").symlink_to("circle")
        with pytest.raises(MapFileError, match=words):
            write_atomically(path, b"new", MapFileError)
        assert sorted(os.listdir()) == ["circle", "pipe"]


class TestChecks:
    def test_nothing_is_changed(self, tmp_path: Path) -> None:
        path = tmp_path / "a.map"
        check_writable(path, "--save-map")
        assert not path.exists()
        path.write_bytes(b"old")
        check_writable(path, "--save-map")
        assert path.read_bytes() == b"old"
        make_folder(tmp_path / "b" / "c")
        assert sorted(tmp_path.rglob("*")) == [path, tmp_path / "b", tmp_path / "b" / "c"]

    def test_full_disk(self, tmp_path: Path) -> None:
        """Files can be made, but nothing can be written to them."""
        limits, handler = resource.getrlimit(resource.RLIMIT_FSIZE), signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (1000, limits[1]))
        try:
            with pytest.raises(MapFileError, match=rf"--out: '{tmp_path}' cannot be written to: File too large"):
                make_folder(tmp_path, MapFileError)
            with pytest.raises(MapFileError, match=r"--save-map: '.*a\.map' cannot be written: File too large"):
                check_writable(tmp_path / "a.map", "--save-map", MapFileError)
            with pytest.raises(MapFileError, match="cannot be written: File too large"):
                write_atomically(tmp_path / "a.map", bytes(2000), MapFileError)
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, limits)
            signal.signal(signal.SIGXFSZ, handler)
        assert not list(tmp_path.iterdir())

    def test_error_of_the_block_is_not_taken_for_one_of_the_disk(self, tmp_path: Path) -> None:
        with pytest.raises(KeyError), replacing(tmp_path / "a.map") as temporary:
            temporary.write_bytes({}["half"])
        assert not list(tmp_path.iterdir())
