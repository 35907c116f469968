"""Ctrl-C and SIGTERM end a run between two frames, so that what was computed can still be written."""

import signal
import threading
from types import FrameType

_REASONS = {signal.SIGINT: "interrupted", signal.SIGTERM: "terminated"}


class Interruption:
    """Remembers the first Ctrl-C or SIGTERM within a `with` block; `check` raises it where the work can stop.

    The second one raises `KeyboardInterrupt` at once, wherever the main thread is, and the third one ends the process.
    A signal that is ignored, such as Ctrl-C in a background job, stays ignored. Outside of the main thread, where
    Python allows no signal handlers, nothing is remembered.

    Attributes:
        reason: "interrupted" by Ctrl-C or "terminated" by SIGTERM; `None` as long as there was neither.
    """

    def __init__(self) -> None:
        """Remember nothing yet."""
        self.reason: str | None = None
        self._before: dict[signal.Signals, signal._HANDLER] = {}

    def __enter__(self) -> "Interruption":
        if threading.current_thread() is threading.main_thread():
            handlers = {number: signal.getsignal(number) for number in _REASONS}
            self._before = {number: handler for number, handler in handlers.items() if handler != signal.SIG_IGN}
        for number in self._before:
            signal.signal(number, self._arrived)
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def check(self) -> None:
        """Stop here if a signal came.

        Raises:
            KeyboardInterrupt: If one came.
        """
        if self.reason is not None:
            raise KeyboardInterrupt(self.reason)

    def _arrived(self, number: int, frame: FrameType | None) -> None:
        del frame
        if self.reason is not None:
            for either in self._before:
                signal.signal(either, signal.SIG_DFL)
            raise KeyboardInterrupt(self.reason)
        self.reason = _REASONS[signal.Signals(number)]
