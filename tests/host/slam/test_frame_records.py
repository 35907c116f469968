"""Records of frames in arrays are those that were added, and an hour of them is small."""

import dataclasses

import pytest

from jaxslam.slam.frame_records import FrameRecords
from jaxslam.slam.frame_result import FrameRecord
from jaxslam.slam.mask_pipeline import MaskSource
from jaxslam.tracking.state import KeyframeReason, TrackStatus

TRACKED = FrameRecord(
    timestamp_ns=1_700_000_000_123_456_789,
    status=TrackStatus.WEAK,
    reason="few inliers",
    num_inliers=41,
    inlier_ratio=0.1 + 0.2,
    num_keyframe_matches=7,
    num_matched=3,
    residual_px=1 / 3,
    keyframe=KeyframeReason.FEW_POINTS,
    dynamic_ratio=0.7,
    mask_source=MaskSource.CALLER,
    mask_age=12,
    detector_error="no GPU",
    track_ms=12.3456789,
    occluded_share=0.0,
    submap=2,
)
UNREADABLE = FrameRecord(-5, TrackStatus.REJECTED, "frame 3: cannot be read")


def test_records_are_those_that_were_added() -> None:
    added = [TRACKED, UNREADABLE, *(dataclasses.replace(TRACKED, timestamp_ns=k) for k in range(5000))]
    records = FrameRecords(added)
    assert len(records) == len(added)
    assert list(records) == added == records
    assert records[-1] == added[-1]
    assert list(records[1:9:3]) == added[1:9:3]
    assert records != added[:-1]
    with pytest.raises(IndexError, match="5002 records, got 5002"):
        records[len(added)]


def test_types_are_those_of_a_record() -> None:
    fields = {field.name: type(getattr(TRACKED, field.name)) for field in dataclasses.fields(FrameRecord)}
    found = FrameRecords([TRACKED])[0]
    assert {name: type(getattr(found, name)) for name in fields} == fields


def test_an_hour_takes_less_than_ten_megabytes() -> None:
    records = FrameRecords()
    for _ in range(8192):
        records.append(TRACKED)
    assert records.num_bytes * 108_000 / 8192 < 10e6
