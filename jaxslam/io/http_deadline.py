"""HTTP connections that abort if a server sends too slowly; the timeout of `urllib` restarts with every byte."""

import http.client
import io
import socket
import time
import urllib.request
from typing import Any

_MIN_BYTES_PER_S = 1000
"""Slowest accepted rate; at a lower one, a recording would take more than a month."""


class TooSlowError(TimeoutError):
    """A server has sent less than 1 kB/s for the duration of the connection's timeout."""


def paced_opener() -> urllib.request.OpenerDirector:
    """Make an opener like that of `urllib.request.urlopen`, except that reading may raise `TooSlowError`."""
    return urllib.request.build_opener(_HttpHandler, _HttpsHandler)


class _PacedReader(io.RawIOBase):
    """Reader of a socket that measures the rate of its bytes."""

    def __init__(self, sock: socket.socket, timeout_s: float) -> None:
        """Open a file of the socket; the socket stays open until both are closed."""
        self._file, self._timeout_s = sock.makefile("rb", buffering=0), timeout_s
        self._began_s, self._num_bytes = time.monotonic(), 0

    def readable(self) -> bool:
        """Return true."""
        return True

    def readinto(self, buffer: Any, /) -> int:
        """Read some bytes into the buffer, and return their number; 0 at the end."""
        num_bytes = self._file.readinto(buffer) or 0
        self._num_bytes += num_bytes
        passed_s = time.monotonic() - self._began_s
        if num_bytes and passed_s > self._timeout_s:
            if self._num_bytes < _MIN_BYTES_PER_S * passed_s:
                raise TooSlowError(f"the server gave {self._num_bytes} bytes in {passed_s:.1f} s")
            self._began_s, self._num_bytes = time.monotonic(), 0
        return num_bytes

    def close(self) -> None:
        """Close the file of the socket, too."""
        self._file.close()
        super().close()


class _PacedResponse(http.client.HTTPResponse):
    """Response that is read through a `_PacedReader` if the socket has a timeout."""

    def __init__(self, sock: socket.socket, *arguments: Any, **options: Any) -> None:
        super().__init__(sock, *arguments, **options)
        timeout_s = sock.gettimeout()
        if timeout_s is not None:
            self.fp.close()
            self.fp = io.BufferedReader(_PacedReader(sock, timeout_s))


class _HttpConnection(http.client.HTTPConnection):
    response_class = _PacedResponse


class _HttpsConnection(http.client.HTTPSConnection):
    response_class = _PacedResponse


class _HttpHandler(urllib.request.HTTPHandler):
    def http_open(self, req: urllib.request.Request) -> Any:
        return self.do_open(_HttpConnection, req)


class _HttpsHandler(urllib.request.HTTPSHandler):
    def https_open(self, req: urllib.request.Request) -> Any:
        return self.do_open(_HttpsConnection, req)
