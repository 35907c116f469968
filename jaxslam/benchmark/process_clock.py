"""Time of this process since it was started, as one who waits for its end would measure it."""

import time
from collections.abc import Iterator
from contextlib import contextmanager


class ProcessClock:
    """Wall and processor time since this process was started, but for what it does while the clock is stopped."""

    def __init__(self, began_s: float) -> None:
        """Begin with the time at which the process was started.

        Args:
            began_s: Time before the process was started, seconds since the epoch.
        """
        self._began_s = began_s
        self._left_out = (0.0, 0.0)

    @contextmanager
    def stopped(self) -> Iterator[None]:
        """Stop the clock within a `with` block."""
        before = self._elapsed()
        try:
            yield
        finally:
            wall_s, cpu_s = (now - then for now, then in zip(self._elapsed(), before, strict=True))
            self._left_out = (self._left_out[0] + wall_s, self._left_out[1] + cpu_s)

    def figures(self) -> dict[str, float]:
        """Return the times up to now: `process_wall_s` and `process_cpu_s`, of all threads together."""
        wall_s, cpu_s = (now - out for now, out in zip(self._elapsed(), self._left_out, strict=True))
        return {"process_wall_s": round(wall_s, 3), "process_cpu_s": round(cpu_s, 3)}

    def _elapsed(self) -> tuple[float, float]:
        return time.time() - self._began_s, time.process_time()
