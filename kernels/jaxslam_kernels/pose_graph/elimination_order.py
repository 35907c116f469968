"""The order in which the nodes of a pose graph are eliminated, computed on the host from its structure."""

import numpy as np

_GROUP_SIZES = (16, 32, 64)
"""Those that `suitable_group_size` chooses from: beyond, the host is faster."""


def band_rank(source: np.ndarray, target: np.ndarray, num_nodes: int) -> np.ndarray:
    """An order of elimination that keeps both ends of every edge close together, by reverse Cuthill-McKee.

    For the host: the graph's structure decides, once for each change of it. A millisecond for thousands of nodes.

    Args:
        source: `(e,)` indices of nodes, those of edges in use only.
        target: `(e,)` indices of nodes.
        num_nodes: Capacity k, slots without edges included.

    Returns:
        `(k,)` each node's place.
    """
    from scipy.sparse import coo_array  # noqa: PLC0415 - only for graphs, on the host
    from scipy.sparse.csgraph import reverse_cuthill_mckee  # noqa: PLC0415

    graph = coo_array((np.ones(len(source)), (source, target)), shape=(num_nodes, num_nodes))
    order = reverse_cuthill_mckee((graph + graph.T).tocsr(), symmetric_mode=True)
    rank = np.empty(num_nodes, np.int32)
    rank[order] = np.arange(num_nodes, dtype=np.int32)
    return rank


def suitable_group_size(source: np.ndarray, target: np.ndarray, rank: np.ndarray) -> int | None:
    """The least group size of a few that makes every step exact in one iteration.

    For the host, like `band_rank`. The sizes are few so that a graph that grows seldom compiles anew.

    Args:
        source: `(e,)` indices of nodes, those of edges in use only.
        target: `(e,)` indices of nodes.
        rank: `(k,)` each node's place, from `band_rank`.

    Returns:
        The size, or `None` if the band is too wide: then `elimination="host"` is faster.
    """
    width = int(np.abs(rank[source] - rank[target]).max(initial=1))
    return next((size for size in _GROUP_SIZES if size >= width), None)
