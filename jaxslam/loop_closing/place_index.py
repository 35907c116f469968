"""Place index: find keyframes by appearance, without a vocabulary.

Each three bytes of a descriptor are a key in a sorted table, so that most descriptors that differ in few bits have a
key in common. Those that do are compared in full, and every feature of an image votes for the keyframes that hold a
similar one, with more weight the fewer they are. Sources: multi-index hashing (Norouzi et al., Fast Exact Search in
Hamming Space with Multi-Index Hashing, 2014) and the weights of a bag of words (Sivic and Zisserman, Video Google,
2003).
"""

import threading
from collections.abc import Set
from itertools import islice
from typing import NamedTuple

import numpy as np
from jaxtyping import Int32, Int64, UInt8, UInt32

from jaxslam.features.matching import hamming_pairs
from jaxslam.features.orb import Features
from jaxslam.map.types import Map

_KEY_BYTES = 3
_NUM_TABLES = 8
_INDEXED_STEP = 2
"""Every second feature of a keyframe is indexed, and all features of an image are searched. On TUM `fr1_rpy` among 350
images of other places, the right keyframe is first in 28 of 29 revisits, as with all features, at half the memory."""
INDEX_BYTES = 52
"""Memory that a feature of a keyframe takes here, bytes."""
_ALIKE_BITS = 40
"""Maximum Hamming distance for a vote. Scores of right and wrong keyframes: 4.5 to 1 with 50, 7.7 to 1 with 40."""
_MIN_VOTES = 4
"""Minimum number of votes of a result. Of 1,456 pairs of frames whose relative pose could be found, of TUM `fr1_rpy`,
Bonn `crowd` and a rendered flat, all had 5 or more. Of the five best results at the first visit of the flat, 83 % have
fewer than 4, and each would take 15 to 25 ms to verify."""


class _Block(NamedTuple):
    """Descriptors of several keyframes, sorted by every key."""

    keyframe: Int64[np.ndarray, " n"]
    descriptor: UInt8[np.ndarray, "n 32"]
    keys: UInt32[np.ndarray, "t n"]
    order: Int32[np.ndarray, "t n"]


class PlaceIndex:
    """Index of keyframes by appearance.

    The results depend on the keyframes it holds, not on the order in which they were added. A keyframe of 1000 features
    takes 52 kB.

    Attributes:
        lock: Lock that a thread must hold while it calls a method of an index that it shares with other threads.
    """

    def __init__(self) -> None:
        """Start without keyframes."""
        self.lock = threading.Lock()
        self._blocks: list[_Block] = []
        self._alive: set[int] = set()
        self._added: set[int] = set()

    @classmethod
    def from_map(cls, slam_map: Map) -> "PlaceIndex":
        """Build an index of all keyframes of a map."""
        index = cls()
        for keyframe in slam_map.keyframes:
            index.add(keyframe.id, keyframe.features)
        return index

    def __len__(self) -> int:
        return len(self._alive)

    def __contains__(self, keyframe_id: int) -> bool:
        return keyframe_id in self._alive

    def ids(self) -> set[int]:
        """Return the ids of the indexed keyframes."""
        return set(self._alive)

    def add(self, keyframe_id: int, features: Features) -> None:
        """Add a keyframe.

        Raises:
            ValueError: If it is already indexed or was removed: ids are never reused.
        """
        if keyframe_id in self._added:
            raise ValueError(f"keyframe {keyframe_id} was added before")
        self._added.add(keyframe_id)
        self._alive.add(keyframe_id)
        self._index(keyframe_id, features)

    def replace(self, keyframe_id: int, features: Features) -> None:
        """Replace the features of a keyframe.

        Raises:
            KeyError: If the keyframe is not indexed.
        """
        if keyframe_id not in self._alive:
            raise KeyError(keyframe_id)
        others, nothing = self._alive - {keyframe_id}, _block(keyframe_id, features.descriptor[:0])
        self._blocks = [
            _merged(block, nothing, others) if keyframe_id in block.keyframe else block for block in self._blocks
        ]
        self._index(keyframe_id, features)

    def _index(self, keyframe_id: int, features: Features) -> None:
        self._blocks.append(_block(keyframe_id, features.descriptor[::_INDEXED_STEP]))
        # Sizes at least halve from block to block, so there are few blocks and each entry is rarely merged.
        while len(self._blocks) > 1 and 2 * len(self._blocks[-1].keyframe) > len(self._blocks[-2].keyframe):
            last = self._blocks.pop()
            self._blocks[-1] = _merged(self._blocks[-1], last, self._alive)

    def remove(self, keyframe_id: int) -> None:
        """Remove a keyframe.

        Raises:
            KeyError: If the keyframe is not indexed.
        """
        self._alive.remove(keyframe_id)

    def query(self, features: Features, exclude: Set[int] = frozenset(), limit: int = 5) -> list[tuple[int, float]]:
        """Find the keyframes that look most like an image.

        Args:
            features: Features of the image.
            exclude: Ids of keyframes to leave out.
            limit: Maximum number of results.

        Returns:
            Ids and scores of those that share at least a few features with it, best first. A score sums, over the image
            features with a similar feature in the keyframe, the logarithm of the number of all keyframes over the
            number of those that have one.
        """
        votes = [_votes(block, features.descriptor) for block in self._blocks]
        feature, keyframe = np.concatenate([np.zeros((2, 0), np.int64), *votes], axis=1)
        known, voted = np.unique(keyframe, return_inverse=True)
        alive = np.isin(known, np.fromiter(self._alive, np.int64))[voted]
        feature, voted = np.divmod(np.unique(feature[alive] * len(known) + voted[alive]), max(len(known), 1))
        holders = np.bincount(feature, minlength=len(features.descriptor))
        rarity = np.log((len(self._alive) + 1) / np.maximum(holders, 1))
        score = np.bincount(voted, rarity[feature], minlength=len(known))
        enough = np.bincount(voted, minlength=len(known)) >= _MIN_VOTES
        best = (at for at in np.lexsort((known, -score)) if enough[at] and int(known[at]) not in exclude)
        return [(int(known[at]), float(score[at])) for at in islice(best, limit)]


def _block(keyframe_id: int, descriptor: UInt8[np.ndarray, "n 32"]) -> _Block:
    keys = _keys(descriptor)
    order = np.argsort(keys, axis=1, kind="stable").astype(np.int32)
    owner = np.full(len(descriptor), keyframe_id, np.int64)
    return _Block(owner, np.ascontiguousarray(descriptor), np.take_along_axis(keys, order, axis=1), order)


def _keys(descriptor: UInt8[np.ndarray, "n 32"]) -> UInt32[np.ndarray, "t n"]:
    keys = np.zeros((len(descriptor), _NUM_TABLES, 4), np.uint8)
    keys[:, :, :_KEY_BYTES] = descriptor[:, : _NUM_TABLES * _KEY_BYTES].reshape(-1, _NUM_TABLES, _KEY_BYTES)
    return np.ascontiguousarray(keys.view("<u4")[:, :, 0].T)


def _merged(first: _Block, second: _Block, alive: Set[int]) -> _Block:
    """Merge two blocks into one, without removed keyframes."""
    owner = np.concatenate([first.keyframe, second.keyframe])
    kept = np.isin(owner, np.fromiter(alive, np.int64))
    place = np.cumsum(kept, dtype=np.int32) - 1
    keys = np.concatenate([first.keys, second.keys], axis=1)
    order = np.concatenate([first.order, second.order + np.int32(len(first.keyframe))], axis=1)
    shape = (_NUM_TABLES, int(kept.sum()))
    keys, order = keys[kept[order]].reshape(shape), place[order[kept[order]]].reshape(shape)
    by_key = np.argsort(keys, axis=1, kind="stable")  # two sorted runs: linear time
    descriptor = np.concatenate([first.descriptor, second.descriptor])[kept]
    return _Block(
        owner[kept], descriptor, np.take_along_axis(keys, by_key, axis=1), np.take_along_axis(order, by_key, axis=1)
    )


def _votes(block: _Block, descriptor: UInt8[np.ndarray, "n 32"]) -> Int64[np.ndarray, "2 k"]:
    """Return image features paired with keyframes of a block that hold a similar one; pairs may repeat."""
    sought, entries = [np.zeros(0, np.int64)], [np.zeros(0, np.int32)]
    for wanted, keys, order in zip(_keys(descriptor), block.keys, block.order, strict=True):
        by_key = np.argsort(wanted)  # neighboring searches then touch the same memory
        start = np.searchsorted(keys, wanted[by_key])
        count = np.searchsorted(keys, wanted[by_key], side="right") - start
        within = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
        sought.append(np.repeat(by_key, count))
        entries.append(order[np.repeat(start, count) + within])
    feature, entry = np.concatenate(sought), np.concatenate(entries)
    alike = hamming_pairs(descriptor[feature], block.descriptor[entry]) <= _ALIKE_BITS
    return np.stack([feature[alike], block.keyframe[entry[alike]]])
