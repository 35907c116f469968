"""Times as text, there and back."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from jaxslam.errors import DatasetError, TrajectoryError
from jaxslam.io.timestamps import decimal_seconds, nanoseconds

LAST_S = 9_200_000_000


@given(st.integers(-LAST_S * 10**9, LAST_S * 10**9))
def test_round_trip(stamp_ns):
    assert nanoseconds(decimal_seconds(stamp_ns), "f:1", DatasetError) == stamp_ns


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("1.305031102160407066e+09", 1305031102160407066),
        ("0.0000000005", 0),
        ("0.0000000015", 2),
        ("-0.5", -500_000_000),
        ("1e-999999999", 0),
        ("0.1" + 80 * "0" + "1", 100_000_000),
    ],
)
def test_reads_exactly(text, expected):
    assert nanoseconds(text, "f:1", DatasetError) == expected


def test_cuts_decimals_off():
    assert decimal_seconds(1_999_999_999, digits=6) == "1.999999"
    assert decimal_seconds(-1_500_000_000, digits=1) == "-1.5"


@pytest.mark.parametrize("text", ["", "one", "nan", "inf", "-inf", "9200000001", "-9200000001", "1.0.0"])
def test_refuses(text):
    with pytest.raises(TrajectoryError, match=rf"f:3: expected a timestamp in seconds, got '{text}'$"):
        nanoseconds(text, "f:3", TrajectoryError)


@pytest.mark.parametrize(
    ("text", "unit"), [("1e11", "milliseconds"), ("1305031102160407", "microseconds"), ("1e99", "nanoseconds")]
)
def test_guesses_the_unit(text, unit):
    with pytest.raises(DatasetError, match=rf"got '{text}' \({unit}\?\)$"):
        nanoseconds(text, "f:3", DatasetError)


def test_refuses_what_is_too_early():
    assert nanoseconds("0", "f:1", DatasetError, least_s=0) == 0
    with pytest.raises(DatasetError, match=r"got '-0\.1'$"):
        nanoseconds("-0.1", "f:1", DatasetError, least_s=0)
