"""The records of the frames of a run, which may last for hours."""

from collections.abc import Iterable, Iterator, Sequence
from typing import Any, overload

import numpy as np

from jaxslam.runtime.record_array import RecordArray
from jaxslam.slam.frame_result import FrameRecord
from jaxslam.slam.mask_pipeline import MaskSource
from jaxslam.tracking.state import KeyframeReason, TrackStatus

_ROW = np.dtype(
    [
        ("timestamp_ns", np.int64),
        ("status", np.int8),
        ("reason", np.int32),
        ("num_inliers", np.int32),
        ("inlier_ratio", np.float64),
        ("num_keyframe_matches", np.int32),
        ("num_matched", np.int32),
        ("residual_px", np.float64),
        ("keyframe", np.int8),
        ("dynamic_ratio", np.float64),
        ("mask_source", np.int8),
        ("mask_age", np.int32),
        ("detector_error", np.int32),
        ("track_ms", np.float64),
        ("occluded_share", np.float64),
        ("submap", np.int32),
    ]
)
"""The fields of `FrameRecord`; texts by their number, `None` as NaN or -1. 79 bytes: an hour at 30 Hz takes 8.5 MB."""
_NO_SUBMAP = -1


class FrameRecords(Sequence[FrameRecord]):
    """A sequence of `FrameRecord`, held in 79 bytes each; `append` adds one."""

    def __init__(self, records: Iterable[FrameRecord] = ()) -> None:
        """Start with some records."""
        self._rows = RecordArray(_ROW)
        self._texts: list[str] = []
        self._number_of: dict[str, int] = {}
        for record in records:
            self.append(record)

    def __len__(self) -> int:
        """Return the number of records."""
        return len(self._rows)

    @overload
    def __getitem__(self, index: int) -> FrameRecord: ...
    @overload
    def __getitem__(self, index: slice) -> "FrameRecords": ...
    def __getitem__(self, index: int | slice) -> "FrameRecord | FrameRecords":
        """Return one record, or the records of a slice.

        Raises:
            IndexError: If there is no such record.
        """
        if isinstance(index, slice):
            return FrameRecords(self[at] for at in range(*index.indices(len(self))))
        at = index + len(self) if index < 0 else index
        if not 0 <= at < len(self):
            raise IndexError(f"expected an index within the {len(self)} records, got {index}")
        return self._record(self._rows[at])

    def __iter__(self) -> Iterator[FrameRecord]:
        """Iterate over the records."""
        return (self[at] for at in range(len(self)))

    def __eq__(self, other: object) -> bool:
        """Return whether both hold equal records."""
        return isinstance(other, Sequence) and list(self) == list(other)

    __hash__ = None  # type: ignore[assignment] - it can grow

    @property
    def num_bytes(self) -> int:
        """Memory that the records take, without their texts, bytes."""
        return self._rows.nbytes

    def append(self, record: FrameRecord) -> None:
        """Add the record of the next frame."""
        self._rows.append(
            (
                record.timestamp_ns,
                record.status,
                self._numbered(record.reason),
                record.num_inliers,
                record.inlier_ratio,
                record.num_keyframe_matches,
                record.num_matched,
                record.residual_px,
                record.keyframe,
                record.dynamic_ratio,
                record.mask_source,
                record.mask_age,
                self._numbered(record.detector_error),
                np.nan if record.track_ms is None else record.track_ms,
                np.nan if record.occluded_share is None else record.occluded_share,
                _NO_SUBMAP if record.submap is None else record.submap,
            )
        )

    def _numbered(self, text: str) -> int:
        """Return the number of a text: there are few different ones."""
        number = self._number_of.setdefault(text, len(self._texts))
        if number == len(self._texts):
            self._texts.append(text)
        return number

    def _record(self, row: np.void) -> FrameRecord:
        values: dict[str, Any] = dict(zip(_ROW.names or (), row.item(), strict=True))
        track_ms, occluded_share, submap = values["track_ms"], values["occluded_share"], values["submap"]
        values |= {
            "status": TrackStatus(values["status"]),
            "reason": self._texts[values["reason"]],
            "keyframe": KeyframeReason(values["keyframe"]),
            "mask_source": MaskSource(values["mask_source"]),
            "detector_error": self._texts[values["detector_error"]],
            "track_ms": None if np.isnan(track_ms) else track_ms,
            "occluded_share": None if np.isnan(occluded_share) else occluded_share,
            "submap": None if submap == _NO_SUBMAP else submap,
        }
        return FrameRecord(**values)
