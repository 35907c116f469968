"""Download a file: interrupted downloads are resumed, and only a complete and checked file appears."""

import hashlib
import http.client
import json
import os
import shutil
import ssl
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, TypeAlias

from jaxslam.errors import DownloadError
from jaxslam.io.http_deadline import TooSlowError, paced_opener

Progress: TypeAlias = Callable[[int, int | None], None]
"""Function that is called with the bytes received so far, and the bytes of the whole file or `None` if unknown."""

_CHUNK_BYTES = 1 << 16
_TRANSIENT = frozenset({408, 425, 429, 500, 502, 503, 504})  # HTTP statuses of temporary failures
_TIMEOUT_S = 20.0
_MAX_BYTES = 1 << 36
"""Size limit of a file whose length neither the server nor the caller knows; such a response could be endless."""
_CHANGED = "the file on the server has changed"


class _TransientError(Exception):
    """A temporary failure, after which the download is tried again. This error never leaves the module."""


@dataclass(frozen=True)
class _Version:
    """Version of the file on the server, stored beside a partial download that only it may complete."""

    url: str
    """Address of the file."""
    validator: str | None = None
    """Strong ETag or date for `If-Range` (RFC 9110, section 13.1.5); `None` if the server gave none."""
    total: int | None = None
    """Size of the whole file in bytes; `None` if the server did not give it."""


@dataclass(frozen=True)
class _Wanted:
    """A download in progress."""

    url: str
    """Address of the file."""
    part: Path
    """File that received bytes are appended to."""
    sha256: str | None
    """Expected SHA-256 of the whole file; `None` if unknown."""
    size: int | None
    """Expected size of the whole file in bytes; `None` if unknown."""
    progress: Progress | None
    """Function that is called after every chunk; `None` for no calls."""
    timeout_s: float
    """Timeout of the connection in seconds."""

    @property
    def note(self) -> Path:
        """File with the version of the partial download."""
        return self.part.with_name(f"{self.part.name}.json")

    @property
    def length(self) -> int:
        """Number of bytes received so far."""
        return self.part.stat().st_size if self.part.is_file() else 0

    def forget(self) -> None:
        """Delete the partial download, so that the next try starts from the beginning."""
        self.part.unlink(missing_ok=True)  # first, so that a note never describes another part
        self.note.unlink(missing_ok=True)


def download(
    url: str,
    path: str | os.PathLike[str],
    *,
    sha256: str | None = None,
    size: int | None = None,
    progress: Progress | None = None,
    timeout_s: float = _TIMEOUT_S,
    waits_s: Sequence[float] = (0.5, 2.0, 6.0),
) -> None:
    """Download a file; an existing file is replaced once the new one is complete and checked.

    Received bytes are written to `PATH.part`, which is kept if the connection or the user interrupts the download. The
    next call resumes from there unless the file on the server has changed. Proxies are taken from the environment
    (`HTTPS_PROXY`, `NO_PROXY`, ...). Only one process may download to a path at a time.

    Args:
        url: Address that begins with `http://` or `https://`.
        path: File to write; its folders are created.
        sha256: SHA-256 of the whole file as 64 hexadecimal digits; `None` if unknown.
        size: Size of the whole file in bytes; `None` if unknown.
        progress: Function that is called after every chunk.
        timeout_s: Longest time in seconds that the server may send nothing, or less than 1 kB/s.
        waits_s: Waiting times in seconds before each further try after a temporary failure. They start again after a
            try that received more bytes than any before.

    Raises:
        DownloadError: If the file cannot be downloaded or written, or is not the expected one; then the received bytes
            are deleted.
    """
    wanted = _Wanted(url, Path(f"{os.fspath(path)}.part"), sha256, size, progress, timeout_s)
    try:
        wanted.part.parent.mkdir(parents=True, exist_ok=True)
        _fetch_with_retries(wanted, waits_s)
        _check(wanted)
        os.replace(wanted.part, path)
        wanted.note.unlink(missing_ok=True)
    except OSError as failure:
        raise DownloadError(f"{path}: cannot be written: {failure}") from failure
    except DownloadError as failure:
        raise DownloadError(f"{url}: {failure}. To do it by hand, place the file at {path}") from failure


def sha256_of(path: str | os.PathLike[str]) -> str:
    """Compute the SHA-256 of a file as 64 lowercase hexadecimal digits.

    Raises:
        OSError: If the file cannot be read.
    """
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _fetch_with_retries(wanted: _Wanted, waits_s: Sequence[float]) -> None:
    """Download until the file is complete, or until the last tries, one more than waits, received no further bytes."""
    tries, best = 0, wanted.length
    while True:
        try:
            return _fetch(wanted)
        except _TransientError as failure:
            tries = 0 if wanted.length > best else tries
            best = max(best, wanted.length)
            if tries == len(waits_s):
                raise DownloadError(f"{failure} (tried {tries + 1} times)") from failure
            time.sleep(waits_s[tries])
            tries += 1


def _fetch(wanted: _Wanted) -> None:
    """Request the missing bytes and append them, or start again if the server sends the whole file."""
    if not wanted.url.lower().startswith(("http://", "https://")):
        raise DownloadError("expected an address that begins with http:// or https://")
    known = _known(wanted)
    offset, whole = wanted.length, known.total if wanted.size is None else wanted.size
    if offset and offset == whole:
        return
    with _open(wanted, offset, known.validator) as response:
        now, start = _offered(wanted.url, response)
        if start is not None and (start != offset or _differ(known, now)):
            wanted.forget()
            raise _TransientError(_CHANGED)
        if wanted.size is not None and now.total not in (None, wanted.size):
            raise DownloadError(f"expected {wanted.size} bytes, the server has {now.total}")
        if (now.total, wanted.size, wanted.sha256) == (None, None, None) and not response.chunked:
            raise DownloadError("the server does not say how long the file is, and no size or SHA-256 is known")
        if start is None:
            offset = 0
            wanted.forget()
            wanted.note.write_text(json.dumps(asdict(now)), encoding="utf-8")
        _check_space(wanted, offset, wanted.size if now.total is None else now.total)
        _append(wanted, response, offset, wanted.size if now.total is None else now.total)


def _known(wanted: _Wanted) -> _Version:
    """Read the version of the partial download; delete a partial download that cannot be resumed and checked."""
    fresh = _Version(wanted.url)
    try:
        known = _Version(**json.loads(wanted.note.read_text(encoding="utf-8")))
    except (FileNotFoundError, ValueError, TypeError):
        wanted.forget()
        return fresh
    too_long = wanted.size is not None and wanted.length > wanted.size
    if known.url != wanted.url or too_long or not (known.validator or wanted.sha256):
        wanted.forget()
        return fresh
    return known


def _open(wanted: _Wanted, offset: int, validator: str | None) -> Any:
    headers = {"User-Agent": "jaxslam", "Accept-Encoding": "identity"}
    if offset:
        headers |= {"Range": f"bytes={offset}-"} | ({"If-Range": validator} if validator else {})
    try:
        request = urllib.request.Request(wanted.url, headers=headers)
        response = paced_opener().open(request, timeout=wanted.timeout_s)
    except urllib.error.HTTPError as refusal:
        refusal.close()
        if refusal.code == http.HTTPStatus.REQUESTED_RANGE_NOT_SATISFIABLE and offset:
            wanted.forget()
            raise _TransientError(_CHANGED) from refusal
        kind = _TransientError if refusal.code in _TRANSIENT else DownloadError
        raise kind(f"the server answers {refusal.code} {refusal.reason}") from refusal
    except TooSlowError as failure:
        raise DownloadError(f"{failure}") from failure
    except (http.client.InvalidURL, ValueError) as failure:
        raise DownloadError(f"{failure}") from failure
    except (OSError, http.client.HTTPException) as failure:
        reason = getattr(failure, "reason", failure)
        kind = DownloadError if isinstance(reason, ssl.SSLCertVerificationError) else _TransientError
        raise kind(f"no connection: {reason}") from failure
    if wanted.url.lower().startswith("https:") and not response.url.startswith("https:"):
        response.close()
        raise DownloadError(f"leads to {response.url}, which is not encrypted")
    return response


def _check_space(wanted: _Wanted, offset: int, total: int | None) -> None:
    free = shutil.disk_usage(wanted.part.parent).free
    if total is not None and total - offset > free:
        raise DownloadError(f"needs {total - offset} more bytes on the disk, where {free} are free")


def _append(wanted: _Wanted, response: Any, offset: int, total: int | None) -> None:
    done = offset
    with wanted.part.open("ab" if offset else "wb") as file:
        while chunk := _read(response):
            file.write(chunk)
            done += len(chunk)
            if wanted.progress is not None:
                wanted.progress(done, total)
            if done > (_MAX_BYTES if total is None else total):
                break
    if total is None and done > _MAX_BYTES:
        wanted.forget()
        raise DownloadError(f"the server gives more than {_MAX_BYTES} bytes and does not say how many there are")
    if total is not None and done > total:
        wanted.forget()
        raise DownloadError(f"expected {total} bytes, the server gives more")
    if total is not None and done < total and not response.chunked:  # chunks say themselves where they end
        raise _TransientError(f"the connection was cut after {done} of {total} bytes")


def _read(response: Any) -> bytes:
    """Read a chunk, empty at the end; separate, so that disk errors are not taken for network errors."""
    try:
        return response.read1(_CHUNK_BYTES)
    except TooSlowError as failure:
        raise DownloadError(f"{failure}; the next call goes on from there") from failure
    except (OSError, http.client.HTTPException) as failure:
        raise _TransientError(f"the connection was cut: {failure}") from failure


def _offered(url: str, response: Any) -> tuple[_Version, int | None]:
    """Return the version on the server, and the offset of the sent bytes; `None` if it sends the whole file."""
    etag, length = response.headers.get("ETag"), response.headers.get("Content-Length", "")
    strong = etag is not None and not etag.startswith("W/")
    validator = etag if strong else response.headers.get("Last-Modified")
    if response.status != http.HTTPStatus.PARTIAL_CONTENT:
        return _Version(url, validator, int(length) if length.isdecimal() else None), None
    span = response.headers.get("Content-Range", "")
    begin, total = span.removeprefix("bytes ").partition("-")[0], span.rpartition("/")[2]
    if not begin.isdecimal():
        raise DownloadError(f"expected a Content-Range in bytes, got '{span}'")
    return _Version(url, validator, int(total) if total.isdecimal() else None), int(begin)


def _differ(known: _Version, now: _Version) -> bool:
    """Return whether two responses are about different files; some servers ignore `If-Range`."""
    pairs = ((known.validator, now.validator), (known.total, now.total))
    return any(old is not None and new is not None and old != new for old, new in pairs)


def _check(wanted: _Wanted) -> None:
    """Raise `DownloadError` and delete the received bytes if they are not the expected file."""
    problem = None
    if wanted.size is not None and wanted.length != wanted.size:
        problem = f"expected {wanted.size} bytes, got {wanted.length}"
    elif wanted.sha256 is not None and (got := sha256_of(wanted.part)) != wanted.sha256.lower():
        problem = f"expected SHA-256 {wanted.sha256}, got {got}"
    if problem is not None:
        wanted.forget()
        raise DownloadError(f"{problem}: another file, or a damaged one")
