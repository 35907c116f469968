"""Warnings about the input of a run, reported once each: in the log, and with the frame that raised them."""

import logging

_log = logging.getLogger(__name__)


class InputWarnings:
    """Warnings about the input of a run; each is logged once and handed out with one frame.

    A frame that is wrong by itself is a `FrameError`. These are for what only looks wrong, or shows after some frames:
    depth in another unit, swapped images, stamps taken on arrival.
    """

    def __init__(self) -> None:
        """Begin without any."""
        self._by_topic: dict[str, str] = {}
        self._new: list[str] = []

    def warn(self, topic: str, text: str) -> None:
        """Say that something looks wrong, unless that was said before.

        Args:
            topic: Topic of the warning; only the first text of a topic is reported.
            text: One sentence that names the field, what was expected and what came, and what to do.
        """
        if topic in self._by_topic:
            return
        self._by_topic[topic] = text
        self._new.append(text)
        _log.warning("%s: %s", topic, text)

    def taken(self) -> tuple[str, ...]:
        """The texts since the last call, for the result of a frame."""
        new, self._new = tuple(self._new), []
        return new

    @property
    def all(self) -> tuple[str, ...]:
        """Every text so far, in order."""
        return tuple(self._by_topic.values())
