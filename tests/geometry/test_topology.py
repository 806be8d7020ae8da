"""Components of graphs: against SciPy, of random graphs, chains and isolated nodes."""

import numpy as np
import pytest
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from reli3d.geometry.topology import graph_components


@pytest.mark.parametrize("count, links", [(1, 0), (5, 0), (2000, 300), (2000, 1500), (2000, 4000), (50_000, 45_000)])
def test_components_are_those_of_scipy_named_by_their_lowest_node(count, links):
    rng = np.random.default_rng(links)
    a, b = rng.integers(0, count, (2, links))
    found = graph_components(a, b, count)
    _, label = connected_components(coo_matrix((np.ones(links), (a, b)), shape=(count, count)), directed=False)
    lowest = np.full(label.max() + 1, count)
    np.minimum.at(lowest, label, np.arange(count))
    assert np.array_equal(found, lowest[label])


@pytest.mark.parametrize("order", [1, -1])
def test_a_long_chain_is_one_component(order):
    """From either end: sets that are merged the wrong way round would make it quadratic, 10^12 steps here."""
    nodes = np.arange(1_000_000)[::order]
    assert not graph_components(nodes[:-1], nodes[1:], len(nodes)).any()


def test_nodes_out_of_range_are_refused():
    good, bad = np.array([0, 1]), np.array([1, 3])
    for a, b in ((good, bad), (bad, good), (good, -good)):
        with pytest.raises(ValueError, match=r"nodes in \[0, 3\)"):
            graph_components(a, b, 3)
    with pytest.raises(ValueError, match="shape"):
        graph_components(good, good[:1], 3)
