"""Convert between decimal seconds, as in files, and int64 nanoseconds, without loss."""

from decimal import Context, Decimal, InvalidOperation

from jaxslam.errors import JaxSlamError

_LAST_S = 9_200_000_000  # int64 nanoseconds end in the year 2262
_UNITS = ((10**17, "nanoseconds"), (10**14, "microseconds"), (10**11, "milliseconds"))
"""Smallest numbers, in seconds the year 5138 or later, that are probably counts of smaller units."""
_EXACT = Context(prec=60)


def nanoseconds(text: str, place: str, error: type[JaxSlamError], *, least_s: int = -_LAST_S) -> int:
    """Convert decimal seconds to nanoseconds, exactly, with half nanoseconds rounded to even.

    A float would lose digits.

    Args:
        text: Decimal seconds, with or without an exponent.
        place: Place of the text, `file:line`, for the message.
        error: Class of the error to raise.
        least_s: Earliest accepted time in seconds.

    Raises:
        JaxSlamError: An error of class `error`, if the text is not a number, not finite, too early, or too late for
            int64; the message guesses another unit.
    """
    problem = f"{place}: expected a timestamp in seconds, got '{text:.80}'"
    try:
        seconds = Decimal(text)
    except InvalidOperation:  # also an exponent of twenty digits, which a float reads as zero
        raise error(problem) from None
    if not seconds.is_finite() or not least_s <= seconds <= _LAST_S:
        guesses = [f" ({unit}?)" for least, unit in _UNITS if seconds.is_finite() and seconds >= least]
        raise error(problem + "".join(guesses[:1]))
    return int(seconds.scaleb(9, _EXACT).to_integral_value(context=_EXACT))


def decimal_seconds(stamp_ns: int, digits: int = 9) -> str:
    """Format nanoseconds as seconds with 1 to 9 decimals; further digits are cut off."""
    whole, rest = divmod(abs(stamp_ns), 10**9)
    return f"{'-' if stamp_ns < 0 else ''}{whole}.{rest:09d}"[: digits - 9 or None]
