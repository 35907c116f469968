"""Downloads from a server on this machine: whole or not at all, resumed, checked, with errors that say what to do."""

import hashlib
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from types import SimpleNamespace

import pytest

from jaxslam.errors import DownloadError
from jaxslam.io import download as module
from jaxslam.io.download import download, sha256_of

FIRST = bytes(range(256)) * 1200  # several reads
SECOND = FIRST[::-1][:-100]
CUT = 100_000
TAG, OTHER_TAG = '"a"', '"b"'


def hash_of(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


@dataclass
class Site:
    """What the server has, and how it behaves."""

    url: str = ""
    content: bytes = FIRST
    etag: str | None = TAG
    ranges: bool = True
    looks_at_if_range: bool = True
    drips: str = ""  # or "headers", "content", "chunks": what is sent byte for byte
    length: str = "given"  # or "chunked", "none"
    cuts: list[int] = field(default_factory=list)  # bytes after which the next answers end
    refusals: list[int] = field(default_factory=list)  # statuses of the next answers
    asked: list[dict[str, str]] = field(default_factory=list)  # headers of each request


class _Handler(BaseHTTPRequestHandler):
    def __init__(self, site: Site, *arguments) -> None:
        self.site = site
        super().__init__(*arguments)

    def log_message(self, format: str, *arguments) -> None:
        del format, arguments

    def do_GET(self) -> None:
        site = self.site
        site.asked.append(dict(self.headers))
        if site.drips:
            self._drip(site.drips)
        elif self.path == "/moved":
            self.send_response(302)
            self.send_header("Location", "/file")
            self.end_headers()
        elif site.refusals:
            self.send_error(site.refusals.pop(0))
        else:
            self._give(site)

    def _drip(self, what: str) -> None:
        start = {
            "headers": b"HTTP/1.1 200 OK\r\nX-More: ",
            "content": b"HTTP/1.1 200 OK\r\nContent-Length: 1000000\r\n\r\n",
            "chunks": b"HTTP/1.1 200 OK\r\nTransfer-Encoding: chunked\r\n\r\n",
        }
        with suppress(OSError):  # until nobody listens
            self.wfile.write(start[what])
            for _ in range(200):
                self.wfile.write(b"0")
                time.sleep(0.02)

    def _give(self, site: Site) -> None:
        start = int(self.headers.get("Range", "bytes=0-").removeprefix("bytes=").removesuffix("-"))
        same = not site.looks_at_if_range or self.headers.get("If-Range", site.etag) == site.etag
        start = start if site.ranges and same else 0
        if start > len(site.content):
            self.send_error(416)
            return
        if site.length == "chunked":
            self.protocol_version = "HTTP/1.1"
        self.send_response(206 if start else 200)
        self.send_header("Connection", "close")
        if start:
            self.send_header("Content-Range", f"bytes {start}-{len(site.content) - 1}/{len(site.content)}")
        if site.etag is not None:
            self.send_header("ETag", site.etag)
        body = site.content[start:]
        if site.length == "given":
            self.send_header("Content-Length", str(len(body)))
        elif site.length == "chunked":
            self.send_header("Transfer-Encoding", "chunked")
            body = b"%x\r\n%s\r\n0\r\n\r\n" % (len(body), body)
        self.end_headers()
        self.wfile.write(body[: site.cuts.pop(0)] if site.cuts else body)


@pytest.fixture
def site(monkeypatch: pytest.MonkeyPatch) -> Iterator[Site]:
    monkeypatch.setenv("no_proxy", "*")
    site = Site()
    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(_Handler, site))
    site.url = f"http://127.0.0.1:{server.server_port}/file"
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
    thread.start()
    yield site
    server.shutdown()
    server.server_close()
    thread.join()


@pytest.fixture
def target(tmp_path: Path) -> Path:
    return tmp_path / "models" / "net.onnx"


def part_of(target: Path) -> Path:
    return target.with_name("net.onnx.part")


def cut_short(site: Site, target: Path, **expected) -> None:
    """Leave a part behind, as a connection does that ends for good."""
    site.cuts = [CUT]
    with pytest.raises(DownloadError, match=f"cut after {CUT} of {len(site.content)} bytes"):
        download(site.url, target, waits_s=(), **expected)
    assert part_of(target).stat().st_size == CUT
    assert not target.exists()


def assert_whole(target: Path, content: bytes) -> None:
    assert target.read_bytes() == content
    assert [path.name for path in target.parent.iterdir()] == [target.name]


class TestWhole:
    def test_plain(self, site: Site, target: Path) -> None:
        told: list[tuple[int, int | None]] = []
        download(site.url, target, progress=lambda done, total: told.append((done, total)))
        assert_whole(target, FIRST)
        assert told == sorted(told)
        assert told[-1] == (len(FIRST), len(FIRST))
        assert "Range" not in site.asked[0]

    def test_checked(self, site: Site, target: Path) -> None:
        download(site.url, target, sha256=hash_of(FIRST).upper(), size=len(FIRST))
        assert_whole(target, FIRST)
        assert sha256_of(target) == hash_of(FIRST)

    def test_replaces_an_old_file(self, site: Site, target: Path) -> None:
        target.parent.mkdir()
        target.write_bytes(b"old")
        download(site.url, target)
        assert_whole(target, FIRST)

    def test_after_a_redirect(self, site: Site, target: Path) -> None:
        download(site.url.replace("file", "moved"), target)
        assert_whole(target, FIRST)
        assert len(site.asked) == 2

    def test_in_chunks_without_a_length(self, site: Site, target: Path) -> None:
        site.length = "chunked"
        download(site.url, target)
        assert_whole(target, FIRST)


class TestResume:
    def test_in_the_same_call(self, site: Site, target: Path) -> None:
        site.cuts = [CUT]
        download(site.url, target, waits_s=(0.0,))
        assert_whole(target, FIRST)
        assert (site.asked[1]["Range"], site.asked[1]["If-Range"]) == (f"bytes={CUT}-", TAG)

    def test_in_the_next_call(self, site: Site, target: Path) -> None:
        cut_short(site, target)
        download(site.url, target)
        assert_whole(target, FIRST)
        assert [headers.get("Range") for headers in site.asked] == [None, f"bytes={CUT}-"]

    def test_in_chunks(self, site: Site, target: Path) -> None:
        site.length, site.cuts = "chunked", [CUT]
        download(site.url, target, waits_s=(0.0,))
        assert_whole(target, FIRST)

    def test_tries_begin_anew_when_one_got_further(self, site: Site, target: Path) -> None:
        site.cuts = [50_000] * 6
        download(site.url, target, waits_s=(0.0,))
        assert_whole(target, FIRST)
        assert len(site.asked) == 7

    def test_server_that_gives_no_parts(self, site: Site, target: Path) -> None:
        site.ranges = False
        cut_short(site, target)
        download(site.url, target)
        assert_whole(target, FIRST)

    def test_server_that_gives_no_parts_and_cuts_is_given_up(self, site: Site, target: Path) -> None:
        site.ranges, site.cuts = False, [CUT] * 9
        with pytest.raises(DownloadError, match="tried 3 times"):
            download(site.url, target, waits_s=(0.0, 0.0))
        assert len(site.asked) == 3

    @pytest.mark.parametrize("looks_at_if_range", [True, False])
    def test_changed_file(self, site: Site, target: Path, looks_at_if_range: bool) -> None:
        cut_short(site, target)
        site.content, site.etag, site.looks_at_if_range = SECOND, OTHER_TAG, looks_at_if_range
        download(site.url, target, waits_s=(0.0,))
        assert_whole(target, SECOND)

    @pytest.mark.parametrize("content", [SECOND, SECOND[:1000]], ids=["shorter", "shorter than the part"])
    def test_file_of_another_length(self, site: Site, target: Path, content: bytes) -> None:
        site.etag = None
        cut_short(site, target, sha256=hash_of(content))
        site.content = content
        download(site.url, target, waits_s=(0.0,), sha256=hash_of(content))
        assert_whole(target, content)

    @pytest.mark.parametrize("etag", [None, 'W/"a"'])
    def test_nothing_tells_a_change(self, site: Site, target: Path, etag: str | None) -> None:
        site.etag = etag
        cut_short(site, target)
        site.content = FIRST[::-1]
        download(site.url, target)
        assert_whole(target, FIRST[::-1])
        assert "Range" not in site.asked[1]

    def test_another_address(self, site: Site, target: Path) -> None:
        """Equal tags at two addresses mean nothing."""
        cut_short(site, target)
        site.content = FIRST[::-1]
        download(f"{site.url}?v=2", target)
        assert_whole(target, FIRST[::-1])

    def test_part_without_a_note(self, site: Site, target: Path) -> None:
        target.parent.mkdir()
        part_of(target).write_bytes(b"somebody else's")
        download(site.url, target)
        assert_whole(target, FIRST)

    @pytest.mark.parametrize("at", [1, len(FIRST)], ids=["in the middle", "at the end"])
    def test_interrupted_by_the_user(self, site: Site, target: Path, at: int) -> None:
        def interrupt(done: int, total: int | None) -> None:
            if done >= at:
                raise KeyboardInterrupt

        with pytest.raises(KeyboardInterrupt):
            download(site.url, target, progress=interrupt)
        kept = part_of(target).stat().st_size
        assert kept >= at
        download(site.url, target)
        assert_whole(target, FIRST)
        assert [headers.get("Range") for headers in site.asked[1:]] == ([f"bytes={kept}-"] if kept < len(FIRST) else [])


class TestErrors:
    def fails(self, url: str, target: Path, *words: str, **expected) -> None:
        with pytest.raises(DownloadError) as error:
            download(url, target, waits_s=(0.0,), **expected)
        for word in (url, f"place the file at {target}", *words):
            assert word in str(error.value)

    def test_wrong_hash(self, site: Site, target: Path) -> None:
        target.parent.mkdir()
        target.write_bytes(b"old")
        self.fails(site.url, target, hash_of(SECOND), hash_of(FIRST), sha256=hash_of(SECOND))
        assert_whole(target, b"old")
        assert len(site.asked) == 1

    @pytest.mark.parametrize("size", [len(FIRST) - 1, len(FIRST) + 1])
    @pytest.mark.parametrize("length", ["given", "chunked", "none"])
    def test_wrong_length(self, site: Site, target: Path, size: int, length: str) -> None:
        site.length = length
        self.fails(site.url, target, f"expected {size} bytes", size=size)
        assert not target.exists()

    def test_unknown_length(self, site: Site, target: Path) -> None:
        site.length = "none"
        self.fails(site.url, target, "does not say how long the file is")
        download(site.url, target, sha256=hash_of(FIRST))
        assert_whole(target, FIRST)

    def test_not_found_is_final(self, site: Site, target: Path) -> None:
        site.refusals = [404]
        self.fails(site.url, target, "404 Not Found")
        assert len(site.asked) == 1

    def test_unavailable_is_tried_again(self, site: Site, target: Path) -> None:
        site.refusals = [503, 503]
        self.fails(site.url, target, "503", "tried 2 times")
        download(site.url, target)
        assert_whole(target, FIRST)

    def test_refused(self, monkeypatch: pytest.MonkeyPatch, target: Path) -> None:
        monkeypatch.setenv("no_proxy", "*")
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))  # not listening
            self.fails(f"http://127.0.0.1:{free.getsockname()[1]}/file", target, "no connection", "refused")

    def test_silent_server(self, monkeypatch: pytest.MonkeyPatch, target: Path) -> None:
        monkeypatch.setenv("no_proxy", "*")
        with socket.socket() as silent:
            silent.bind(("127.0.0.1", 0))
            silent.listen()
            self.fails(f"http://127.0.0.1:{silent.getsockname()[1]}/file", target, "timed out", timeout_s=0.05)

    @pytest.mark.parametrize("drip", ["headers", "content", "chunks"])
    def test_server_that_drips(self, site: Site, target: Path, drip: str) -> None:
        """Byte for byte, each in time; what came is kept where it is worth something."""
        site.drips = drip
        began = time.monotonic()
        self.fails(site.url, target, "the server gave", timeout_s=0.3)
        assert time.monotonic() - began < 2
        assert len(site.asked) == 1

    def test_no_end(self, monkeypatch: pytest.MonkeyPatch, site: Site, target: Path) -> None:
        """Nobody knows the length."""
        monkeypatch.setattr(module, "_MAX_BYTES", len(FIRST) - 1)
        site.length = "chunked"
        self.fails(site.url, target, f"the server gives more than {len(FIRST) - 1} bytes")
        assert not list(target.parent.iterdir())
        download(site.url, target, size=len(FIRST))
        assert_whole(target, FIRST)

    def test_disk_without_space(self, monkeypatch: pytest.MonkeyPatch, site: Site, target: Path) -> None:
        monkeypatch.setattr(module.shutil, "disk_usage", lambda _: SimpleNamespace(free=CUT))
        self.fails(site.url, target, f"needs {len(FIRST)} more bytes on the disk, where {CUT} are free")
        assert len(site.asked) == 1

    @pytest.mark.parametrize("url", ["ftp://127.0.0.1/file", "file:///etc/hostname", "net.onnx", "http://127.0.0.1:x/"])
    def test_no_address(self, target: Path, url: str) -> None:
        self.fails(url, target)

    def test_leads_away_from_encryption(self, monkeypatch: pytest.MonkeyPatch, target: Path) -> None:
        answer = SimpleNamespace(url="http://elsewhere/file", close=lambda: None)
        opener = SimpleNamespace(open=lambda *_, **__: answer)
        monkeypatch.setattr(module, "paced_opener", lambda: opener)
        self.fails("https://here/file", target, "http://elsewhere/file, which is not encrypted")

    def test_folder_cannot_be_made(self, site: Site, tmp_path: Path) -> None:
        (tmp_path / "models").write_text("a file")
        with pytest.raises(DownloadError, match="cannot be written"):
            download(site.url, tmp_path / "models" / "net.onnx")
        assert not site.asked
