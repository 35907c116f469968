"""Write OctoMap's octree files: `.bt` (occupied or free) and `.ot` (log-odds).

Format: the sources of OctoMap 1.10, `OcTreeBaseImpl::writeData` and `OccupancyOcTreeBase::writeBinaryNode`: sixteen
levels, children ordered by their x, y, z bits, nodes in depth-first order, parents first. There is no loop over nodes:
sorting nodes by Morton code and then by level gives this order.
"""

import os
from typing import NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Bool, Float32, Int, UInt64

from jaxslam.dense.occupancy import Occupancy
from jaxslam.errors import MapFileError
from jaxslam.io.atomic_files import write_atomically

PathLike: TypeAlias = str | os.PathLike[str]

LEVELS = 16
_HALF = 1 << (LEVELS - 1)


class Octree(NamedTuple):
    """Nodes of an octree in depth-first order, parents first.

    Attributes:
        code: `(n,)` Morton code of the first of the smallest cells in each node.
        level: `(n,)` level of each node: 0 for the root, 16 for the smallest cells.
        value: `(n,)` log-odds of each node; for a node with children, the largest of theirs.
        leaf: `(n,)` mask of the nodes without children.
    """

    code: UInt64[np.ndarray, " n"]
    level: Int[np.ndarray, " n"]
    value: Float32[np.ndarray, " n"]
    leaf: Bool[np.ndarray, " n"]


def write_bt(path: PathLike, cells: Occupancy) -> None:
    """Write the occupied and the free cells as a `.bt` file, which `octomap` and its servers read.

    Raises:
        MapFileError: If the file cannot be written, nothing is known, or a cell is beyond the 65,536 along an axis.
    """
    binary = np.where(cells.log_odds >= 0, np.float32(1), np.float32(-1))
    tree = octree(cells._replace(log_odds=binary))
    pairs = np.where(tree.leaf, np.where(tree.value > 0, 2, 1), 3)
    inner = np.flatnonzero(~tree.leaf)
    words = np.zeros(len(tree.code), np.uint16)
    parent, child = _parents(tree)
    np.bitwise_or.at(words, parent, (pairs[1:] << (2 * child)).astype(np.uint16))
    data = words[inner].astype("<u2").tobytes()
    write_atomically(path, _header("OcTree binary file", tree, cells.cell_m) + data, MapFileError)


def write_ot(path: PathLike, cells: Occupancy) -> None:
    """Write the log-odds of all cells as an `.ot` file.

    Raises:
        MapFileError: If the file cannot be written, nothing is known, or a cell is beyond the 65,536 along an axis.
    """
    tree = octree(cells)
    parent, child = _parents(tree)
    records = np.zeros(len(tree.code), np.dtype([("value", "<f4"), ("children", "u1")]))
    records["value"] = tree.value
    children = np.zeros(len(records), np.uint8)
    np.bitwise_or.at(children, parent, (1 << child).astype(np.uint8))
    records["children"] = children
    header = _header("OcTree file", tree, cells.cell_m)
    write_atomically(path, header + records.tobytes(), MapFileError)


def octree(cells: Occupancy) -> Octree:
    """Build the octree of a grid, merging eight equal children into their parent.

    Raises:
        MapFileError: If nothing is known, or a cell is beyond the 65,536 along an axis.
    """
    index = np.argwhere(cells.known) + cells.first + _HALF
    if not len(index):
        raise MapFileError("octree: expected cells that are known, got none")
    if index.min() < 0 or index.max() >= 2 * _HALF:
        raise MapFileError(
            f"octree: expected cells at most {_HALF} cells of {cells.cell_m:g} m from the origin,"
            f" got some at {np.abs(index - _HALF).max()}"
        )
    code, value = _morton(index), cells.log_odds[cells.known]
    order = np.argsort(code)
    code, value, leaf = code[order], value[order], np.ones(len(code), bool)
    levels: list[Octree] = []
    for level in range(LEVELS, 0, -1):
        parent = code >> np.uint64(3)
        first = np.flatnonzero(np.append(True, parent[1:] != parent[:-1]))
        count = np.diff(np.append(first, len(parent)))
        least, most = np.minimum.reduceat(value, first), np.maximum.reduceat(value, first)
        merged = (count == 8) & np.logical_and.reduceat(leaf, first) & (least == most)
        stays = np.repeat(~merged, count)
        shift = np.uint64(3 * (LEVELS - level))
        levels.append(Octree(code[stays] << shift, np.full(stays.sum(), level), value[stays], leaf[stays]))
        code, value, leaf = parent[first], most, merged
    levels.append(Octree(code << np.uint64(3 * LEVELS), np.zeros(1, np.int64), value, leaf))
    code, level, value, leaf = (np.concatenate(column) for column in zip(*levels, strict=True))
    order = np.lexsort((level, code))
    return Octree(code[order], level[order], value[order], leaf[order])


def _morton(index: Int[np.ndarray, "n 3"]) -> UInt64[np.ndarray, " n"]:
    """Interleave the bits of three 16-bit indices; the bit of x is the lowest of each three."""
    code = np.zeros(len(index), np.uint64)
    for axis in range(3):
        bits = index[:, axis].astype(np.uint64)
        for shift, mask in ((32, 0x001F00000000FFFF), (16, 0x001F0000FF0000FF), (8, 0x100F00F00F00F00F)):
            bits = (bits | (bits << np.uint64(shift))) & np.uint64(mask)
        for shift, mask in ((4, 0x10C30C30C30C30C3), (2, 0x1249249249249249)):
            bits = (bits | (bits << np.uint64(shift))) & np.uint64(mask)
        code |= bits << np.uint64(axis)
    return code


def _parents(tree: Octree) -> tuple[np.ndarray, np.ndarray]:
    """Return, for every node but the root, the index of its parent and its number among the parent's children."""
    parent = np.zeros(len(tree.code) - 1, np.int64)
    for level in range(1, LEVELS + 1):
        mine = np.flatnonzero(tree.level == level)
        above = np.flatnonzero(tree.level == level - 1)
        parent[mine - 1] = above[np.searchsorted(above, mine) - 1]
    shift = (3 * (LEVELS - tree.level[1:])).astype(np.uint64)
    return parent, ((tree.code[1:] >> shift) & np.uint64(7)).astype(np.int64)


def _header(kind: str, tree: Octree, cell_m: float) -> bytes:
    lines = (
        f"# Octomap {kind}",
        "# (feel free to add / change comments, but leave the first line as it is!)",
        "#",
        "id OcTree",
        f"size {len(tree.code)}",
        f"res {cell_m!r}",
        "data\n",
    )
    return "\n".join(lines).encode()
