"""`jaxslam data`: the table, and recordings that come from a server on this machine."""

import hashlib
import io
import tarfile
import threading
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import partial
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from command_line import failing
from tiny_recording import write_recording

from jaxslam.cli import data as data_command
from jaxslam.cli import fetch
from jaxslam.cli.entry_point import main
from jaxslam.datasets import catalog as recordings
from jaxslam.datasets import open_dataset
from jaxslam.datasets.catalog import Recording, find_recording
from jaxslam.io.download import download

fails = failing("data")

TUM, BONN = "rgbd_dataset_freiburg3_walking_xyz", "rgbd_bonn_crowd"
CUT = 1000


@dataclass
class Site:
    """What the server has, by path, and how it behaves."""

    url: str = ""
    files: dict[str, bytes] = field(default_factory=dict)
    cuts: list[int] = field(default_factory=list)  # bytes after which the next answers end
    asked: list[str | None] = field(default_factory=list)  # range of each request


class _Handler(BaseHTTPRequestHandler):
    def __init__(self, site: Site, *arguments) -> None:
        self.site = site
        super().__init__(*arguments)

    def log_message(self, format: str, *arguments) -> None:
        del format, arguments

    def do_GET(self) -> None:
        span = self.headers.get("Range")
        self.site.asked.append(span)
        whole = self.site.files.get(self.path)
        if whole is None:
            self.send_error(404)
            return
        start = int((span or "bytes=0-").removeprefix("bytes=").removesuffix("-"))
        body = whole[start:]
        self.send_response(206 if start else 200)
        if start:
            self.send_header("Content-Range", f"bytes {start}-{len(whole) - 1}/{len(whole)}")
        self.send_header("ETag", f'"{hashlib.sha256(whole).hexdigest()}"')
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body[: self.site.cuts.pop(0)] if self.site.cuts else body)


@pytest.fixture(scope="module")
def archives(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """A small recording as TUM and as Bonn give theirs out."""
    tar, zipped = io.BytesIO(), io.BytesIO()
    folder = write_recording(tmp_path_factory.mktemp("recording") / "walk")
    with tarfile.open(fileobj=tar, mode="w:gz") as archive:
        archive.add(folder, arcname=TUM)
    with zipfile.ZipFile(zipped, "w", zipfile.ZIP_DEFLATED) as archive:
        for file in sorted(folder.rglob("*")):
            archive.write(file, Path(BONN) / file.relative_to(folder))
    return {TUM: tar.getvalue(), BONN: zipped.getvalue()}


@pytest.fixture
def site(monkeypatch: pytest.MonkeyPatch, archives: dict[str, bytes]) -> Iterator[Site]:
    monkeypatch.setenv("no_proxy", "*")
    site = Site(files={f"/{TUM}.tgz": archives[TUM], f"/{BONN}.zip": archives[BONN]})
    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(_Handler, site))
    site.url = f"http://127.0.0.1:{server.server_port}"
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
    thread.start()
    yield site
    server.shutdown()
    server.server_close()
    thread.join()


@pytest.fixture(autouse=True)
def cache(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """The cache folder for recordings, not there yet; no folder of the user's."""
    monkeypatch.delenv("JAXSLAM_DATA", raising=False)
    folder = tmp_path / "cache"
    monkeypatch.setattr(recordings, "platformdirs", SimpleNamespace(user_cache_dir=lambda *_, **__: str(folder)))
    return folder / "recordings"


Serve = Callable[..., Recording]


@pytest.fixture
def serve(monkeypatch: pytest.MonkeyPatch, site: Site) -> Serve:
    """Have a recording come from the server, with fields changed; nothing is tried twice."""
    known = recordings.known_recordings()
    monkeypatch.setattr(recordings, "known_recordings", lambda: known)
    monkeypatch.setattr(fetch, "download", partial(download, waits_s=()))

    def change(name: str, **fields: Any) -> Recording:
        ending = (known[name].url or "")[-4:]
        plain = {"url": f"{site.url}/{name}{ending}", "size_bytes": None, "sha256": None}
        known[name] = replace(known[name], **(plain | fields))
        return known[name]

    return change


def names_in(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


class TestHelp:
    @pytest.mark.parametrize(
        ("arguments", "words"),
        [
            (["--help"], ["data"]),
            (["data", "--help"], ["list", "get"]),
            (["data", "get", "--help"], ["--keep-archive"]),
        ],
    )
    def test_names_the_commands(
        self, capsys: pytest.CaptureFixture[str], arguments: list[str], words: list[str]
    ) -> None:
        with pytest.raises(SystemExit) as stop:
            main(arguments)
        assert stop.value.code == 0
        out = capsys.readouterr().out
        assert all(word in out for word in words)


class TestList:
    def row(self, out: str, name: str) -> str:
        (line,) = (line for line in out.splitlines() if line.split()[:1] == [name])
        return line

    def test_all(self, capsys: pytest.CaptureFixture[str], cache: Path) -> None:
        here = write_recording(cache / BONN)
        main(["data", "list"])
        out = capsys.readouterr().out
        for name, known in recordings.known_recordings().items():
            row = self.row(out, name)
            assert f"{known.dataset}, license: {known.license}, see {known.page}" in out
            assert row.split()[-1] == ("yes" if name == BONN else "no")
        assert f"{BONN}: {here}" in out.splitlines()
        assert "0.53 GB" in self.row(out, TUM)
        assert "about 0.4 GB" in self.row(out, BONN)
        assert f"1 of {len(recordings.known_recordings())} are on this machine" in out
        assert f"Downloads go to {cache}" in out

    def test_missing(self, capsys: pytest.CaptureFixture[str], cache: Path) -> None:
        write_recording(cache / BONN)
        main(["data", "list", "--missing"])
        out = capsys.readouterr().out
        assert f"{BONN} " not in out
        assert f"{TUM}: {recordings.known_recording(TUM).url}" in out.splitlines()
        assert f"kitti_05: {recordings.known_recording('kitti_05').how}" in out.splitlines()

    def test_bad_folder(
        self, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
    ) -> None:
        monkeypatch.setenv("JAXSLAM_DATA", str(tmp_path / "nowhere"))
        assert "JAXSLAM_DATA: expected a folder" in fails(capsys, "list")


class TestGet:
    @pytest.mark.parametrize("name", [TUM, BONN])
    def test_whole_path(
        self, capsys: pytest.CaptureFixture[str], cache: Path, serve: Serve, archives: dict[str, bytes], name: str
    ) -> None:
        content = archives[name]
        known = serve(name, size_bytes=len(content), sha256=hashlib.sha256(content).hexdigest())
        main(["data", "get", name])
        out = capsys.readouterr().out
        assert names_in(cache) == [name]
        assert find_recording(name) == cache / name
        assert f"license: {known.license}, see {known.page}" in out
        assert all(word in out for word in ("Downloading", "Unpacking"))
        assert out.splitlines()[-1] == f"To track it: jaxslam run {cache / name}"
        dataset = open_dataset(cache / name)
        assert len(dataset) == 6
        assert np.isfinite(dataset.timestamps_ns).all()

    def test_without_size_or_hash(self, cache: Path, serve: Serve) -> None:
        serve(TUM)
        main(["data", "get", TUM])
        assert names_in(cache) == [TUM]

    def test_into_a_folder_with_the_archive_kept(
        self,
        capsys: pytest.CaptureFixture[str],
        tmp_path: Path,
        cache: Path,
        site: Site,
        serve: Serve,
        archives: dict[str, bytes],
    ) -> None:
        serve(TUM)
        out = tmp_path / "my data"
        main(["data", "get", TUM, "--out", str(out), "--keep-archive"])
        assert names_in(out) == [TUM, f"{TUM}.tgz"]
        assert (out / f"{TUM}.tgz").read_bytes() == archives[TUM]
        assert not cache.exists()
        assert f"To track it: jaxslam run '{out / TUM}'" in capsys.readouterr().out
        main(["data", "get", TUM, "--out", str(out)])
        assert f"{TUM} is on this machine: {out / TUM}" in capsys.readouterr().out
        assert len(site.asked) == 1

    def test_already_there(
        self,
        capsys: pytest.CaptureFixture[str],
        monkeypatch: pytest.MonkeyPatch,
        tmp_path: Path,
        site: Site,
        serve: Serve,
    ) -> None:
        serve(TUM)
        here = write_recording(tmp_path / "chosen" / "tum" / TUM)
        monkeypatch.setenv("JAXSLAM_DATA", str(tmp_path / "chosen"))
        main(["data", "get", TUM])
        assert capsys.readouterr().out.splitlines() == [
            f"{TUM} is on this machine: {here}",
            f"To track it: jaxslam run {here}",
        ]
        assert not site.asked

    @pytest.mark.parametrize("known_size", [True, False])
    def test_resumes_after_a_cut(
        self,
        capsys: pytest.CaptureFixture[str],
        cache: Path,
        site: Site,
        serve: Serve,
        archives: dict[str, bytes],
        known_size: bool,
    ) -> None:
        serve(TUM, size_bytes=len(archives[TUM]) if known_size else None)
        site.cuts = [CUT]
        assert f"cut after {CUT} of {len(archives[TUM])} bytes" in fails(capsys, "get", TUM)
        assert (cache / f"{TUM}.tgz.part").stat().st_size == CUT
        main(["data", "get", TUM])
        assert site.asked == [None, f"bytes={CUT}-"]
        assert names_in(cache) == [TUM]

    def test_archive_placed_by_hand(self, cache: Path, site: Site, serve: Serve, archives: dict[str, bytes]) -> None:
        serve(BONN, size_bytes=len(archives[BONN]))
        cache.mkdir(parents=True)
        (cache / f"{BONN}.zip").write_bytes(archives[BONN])
        main(["data", "get", BONN])
        assert names_in(cache) == [BONN]
        assert not site.asked


class TestFailures:
    def test_wrong_hash(self, capsys: pytest.CaptureFixture[str], cache: Path, serve: Serve) -> None:
        serve(TUM, sha256="0" * 64)
        assert f"expected SHA-256 {'0' * 64}, got" in fails(capsys, "get", TUM)
        assert names_in(cache) == []

    def test_wrong_size(self, capsys: pytest.CaptureFixture[str], cache: Path, serve: Serve) -> None:
        serve(TUM, size_bytes=10)
        assert "expected 10 bytes, the server has" in fails(capsys, "get", TUM)
        assert names_in(cache) == []

    @pytest.mark.parametrize(
        ("fields", "expected"),
        [({"size_bytes": 10}, "expected 10 bytes"), ({"sha256": "0" * 64}, "expected SHA-256 000")],
    )
    def test_wrong_archive_placed_by_hand(
        self,
        capsys: pytest.CaptureFixture[str],
        cache: Path,
        serve: Serve,
        archives: dict[str, bytes],
        fields: dict[str, Any],
        expected: str,
    ) -> None:
        serve(TUM, **fields)
        cache.mkdir(parents=True)
        archive = cache / f"{TUM}.tgz"
        archive.write_bytes(archives[TUM])
        message = fails(capsys, "get", TUM)
        assert message.startswith(f"{archive}: {expected}")
        assert names_in(cache) == [archive.name]  # it is the user's own

    def test_damaged(self, capsys: pytest.CaptureFixture[str], cache: Path, site: Site, serve: Serve) -> None:
        serve(TUM)
        site.files[f"/{TUM}.tgz"] = site.files[f"/{TUM}.tgz"][:-20]
        message = fails(capsys, "get", TUM)
        assert f"{TUM}.tgz: damaged" in message
        assert message.endswith(f"To begin anew, delete {cache / f'{TUM}.tgz'}")
        assert names_in(cache) == [f"{TUM}.tgz"]

    @pytest.mark.parametrize(
        ("name", "kind", "expected"),
        [
            (f"{TUM}/../../evil", tarfile.REGTYPE, "expected files inside one folder"),
            ("/evil", tarfile.REGTYPE, "expected files inside one folder"),
            (f"{TUM}/link", tarfile.SYMTYPE, "got the link or device"),
        ],
    )
    def test_evil(
        self,
        capsys: pytest.CaptureFixture[str],
        cache: Path,
        site: Site,
        serve: Serve,
        name: str,
        kind: bytes,
        expected: str,
    ) -> None:
        serve(TUM)
        made = io.BytesIO()
        with tarfile.open(fileobj=made, mode="w:gz") as archive:
            entry = tarfile.TarInfo(name)
            entry.type, entry.linkname = kind, "/etc"
            archive.addfile(entry)
        site.files[f"/{TUM}.tgz"] = made.getvalue()
        assert expected in fails(capsys, "get", TUM)
        assert names_in(cache) == [f"{TUM}.tgz"]
        assert not (cache.parent / "evil").exists()

    def test_no_recording_in_it(
        self, capsys: pytest.CaptureFixture[str], cache: Path, site: Site, serve: Serve, archives: dict[str, bytes]
    ) -> None:
        serve(TUM)
        made = io.BytesIO()
        with zipfile.ZipFile(made, "w") as archive:
            archive.writestr("index.html", "not here any more")
        site.files[f"/{TUM}.tgz"] = made.getvalue()
        assert "got one without rgb.txt and depth.txt" in fails(capsys, "get", TUM)
        assert names_in(cache) == [f"{TUM}.tgz"]

    @pytest.mark.parametrize("known_size", [True, False])
    def test_no_space(
        self,
        capsys: pytest.CaptureFixture[str],
        monkeypatch: pytest.MonkeyPatch,
        cache: Path,
        site: Site,
        serve: Serve,
        archives: dict[str, bytes],
        known_size: bool,
    ) -> None:
        size = len(archives[TUM])
        serve(TUM, size_bytes=size if known_size else None)
        monkeypatch.setattr(data_command.shutil, "disk_usage", lambda _: SimpleNamespace(free=size))
        message = fails(capsys, "get", TUM)
        assert f"{cache}: expected" in message
        assert "GB of free space" in message
        assert message.endswith("--out names another folder")
        assert len(site.asked) == (0 if known_size else 1)
        assert not (cache / TUM).exists()
        monkeypatch.setattr(data_command.shutil, "disk_usage", lambda _: SimpleNamespace(free=3 * size))
        main(["data", "get", TUM])
        assert names_in(cache) == [TUM]

    def test_interrupted(
        self, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, cache: Path, site: Site, serve: Serve
    ) -> None:
        """The archive stays, and the next call goes on with it."""
        serve(TUM)

        def stop(*_: Any, **__: Any) -> None:
            raise KeyboardInterrupt

        with monkeypatch.context() as patch:
            patch.setattr("jaxslam.io.archive.tarfile.TarFile.extract", stop)
            with pytest.raises(SystemExit) as end:
                main(["data", "get", TUM])
        assert end.value.code == 130
        assert capsys.readouterr().err == "error: interrupted\n"
        assert names_in(cache) == [f"{TUM}.tgz"]
        main(["data", "get", TUM])
        assert names_in(cache) == [TUM]
        assert len(site.asked) == 1

    def test_unwritable(self, capsys: pytest.CaptureFixture[str], tmp_path: Path, serve: Serve) -> None:
        serve(TUM)
        (tmp_path / "file").touch()
        message = fails(capsys, "get", TUM, "--out", str(tmp_path / "file"))
        assert str(tmp_path / "file") in message
        assert "cannot be written" in message

    def test_not_on_the_server(self, capsys: pytest.CaptureFixture[str], cache: Path, site: Site, serve: Serve) -> None:
        serve(TUM)
        site.files.clear()
        message = fails(capsys, "get", TUM)
        assert "the server answers 404" in message
        assert message.endswith(f"place the file at {cache / f'{TUM}.tgz'}")

    def test_not_alone(self, capsys: pytest.CaptureFixture[str]) -> None:
        message = fails(capsys, "get", "kitti_05")
        assert "kitti_05 cannot be downloaded alone" in message
        assert "register" in message
        assert "https://www.cvlibs.net/datasets/kitti/eval_odometry.php" in message

    def test_unknown(self, capsys: pytest.CaptureFixture[str]) -> None:
        assert f"did you mean '{TUM}'?" in fails(capsys, "get", "fr3_walking_xy")
