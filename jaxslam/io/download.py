"""Fetching one file over the web: resumed where it was cut, checked, and in place as a whole or not at all."""

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
"""Is told the bytes that are there and the bytes there will be, if that is known."""

_CHUNK_BYTES = 1 << 16
_TRANSIENT = frozenset({408, 425, 429, 500, 502, 503, 504})  # HTTP statuses that may be others in a moment
_TIMEOUT_S = 20.0
_MAX_BYTES = 1 << 36
"""Of a file whose length neither the server nor the caller knows; it could have no end."""
_CHANGED = "the file on the server has changed"


class _TransientError(Exception):
    """Worth another try; never leaves this file."""


@dataclass(frozen=True)
class _Version:
    """What the server has, as it said; kept beside a part, so that it is not continued with something else."""

    url: str
    validator: str | None = None
    """Strong ETag or date, for `If-Range` (RFC 9110, section 13.1.5)."""
    total: int | None = None
    """Bytes of the whole."""


@dataclass(frozen=True)
class _Wanted:
    """What to fetch, and where it grows."""

    url: str
    part: Path
    sha256: str | None
    size: int | None
    progress: Progress | None
    timeout_s: float

    @property
    def note(self) -> Path:
        """File that says which version the part is of."""
        return self.part.with_name(f"{self.part.name}.json")

    @property
    def length(self) -> int:
        """Bytes that are there."""
        return self.part.stat().st_size if self.part.is_file() else 0

    def forget(self) -> None:
        """Begin anew the next time."""
        self.part.unlink(missing_ok=True)  # first, so that a note never speaks of another part
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
    """Fetch a file; an old one of that name is replaced once the new one is whole and has been checked.

    Bytes go to `PATH.part`, which stays when the connection or the user ends it, and the next call goes on from there
    unless the file on the server has changed. Proxies are those of the environment (`HTTPS_PROXY`, `NO_PROXY`, ...).
    One process at a time for a path.

    Args:
        url: http or https.
        path: Where the file goes; folders are made.
        sha256: Of the whole file, 64 hexadecimal digits, if known.
        size: Bytes of the whole file, if known.
        progress: Called after each piece.
        timeout_s: Longest silence of the server, seconds; and how long it may give less than 1 kB/s.
        waits_s: Seconds before each further try after a passing failure; a try that got further starts them anew.

    Raises:
        DownloadError: If it cannot be fetched or written, or is not the file expected; what came is deleted then.
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
    """The SHA-256 of a file, 64 lower-case hexadecimal digits.

    Raises:
        OSError: If it cannot be read.
    """
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _fetch_with_retries(wanted: _Wanted, waits_s: Sequence[float]) -> None:
    """Fetch until it is whole, or until as many tries as there are waits got no further than the best before."""
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
    """One try: ask for what is missing and append it, or begin anew if the server gives the whole file."""
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
    """What the part is of; without a part that could be checked and continued, there is none afterwards."""
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
    """What has come, nothing at the end; a function of its own, for a failing disk is another matter."""
    try:
        return response.read1(_CHUNK_BYTES)
    except TooSlowError as failure:
        raise DownloadError(f"{failure}; the next call goes on from there") from failure
    except (OSError, http.client.HTTPException) as failure:
        raise _TransientError(f"the connection was cut: {failure}") from failure


def _offered(url: str, response: Any) -> tuple[_Version, int | None]:
    """What the server has, and where the part it sends begins; `None` if it sends the whole."""
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
    """Whether two answers speak of different files; some servers do not look at `If-Range`."""
    pairs = ((known.validator, now.validator), (known.total, now.total))
    return any(old is not None and new is not None and old != new for old, new in pairs)


def _check(wanted: _Wanted) -> None:
    """Raise `DownloadError`, and delete what came, if it is not the file expected."""
    problem = None
    if wanted.size is not None and wanted.length != wanted.size:
        problem = f"expected {wanted.size} bytes, got {wanted.length}"
    elif wanted.sha256 is not None and (got := sha256_of(wanted.part)) != wanted.sha256.lower():
        problem = f"expected SHA-256 {wanted.sha256}, got {got}"
    if problem is not None:
        wanted.forget()
        raise DownloadError(f"{problem}: another file, or a damaged one")
