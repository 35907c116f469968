"""An array of records that grows, for hours of frames."""

from typing import Any

import numpy as np

_BLOCK = 4096
"""Number of records for which memory is taken at once."""


class RecordArray:
    """Records of one structured type, held in blocks: `append` copies none of those that are there."""

    def __init__(self, dtype: np.dtype) -> None:
        """Start with no records."""
        self._dtype = dtype
        self._blocks: list[np.ndarray] = []
        self._length = 0

    def __len__(self) -> int:
        """Return the number of records."""
        return self._length

    def __getitem__(self, index: int) -> np.void:
        """Return the record at an index from 0 to the length."""
        return self._blocks[index // _BLOCK][index % _BLOCK]

    @property
    def nbytes(self) -> int:
        """Memory that the records take, bytes."""
        return sum(block.nbytes for block in self._blocks)

    def append(self, values: tuple[Any, ...]) -> None:
        """Add a record, given by the values of its fields."""
        at = self._length % _BLOCK
        if at == 0:
            self._blocks.append(np.zeros(_BLOCK, self._dtype))
        self._blocks[-1][at] = values
        self._length += 1

    def array(self) -> np.ndarray:
        """Return all records in one array."""
        return np.concatenate([np.zeros(0, self._dtype), *self._blocks])[: self._length]
