"""Connected components of a graph, by sets that grow together (Tarjan 1975): one thread, in the order of the links."""

import warp as wp

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": "-march=native"})


@wp.func
def root_of(parent: wp.array[wp.int32], i: int) -> int:
    """Smallest member of the set of ``i``; halves the path on its way."""
    r = int(i)
    while parent[r] != r:
        parent[r] = parent[parent[r]]
        r = parent[r]
    return r


@wp.kernel
def components_kernel(
    start: int,
    # in
    a: wp.array[wp.int32],  # (L,) ends of the links
    b: wp.array[wp.int32],
    # out
    parent: wp.array[wp.int32],  # (N,) each its own at first; then the lowest node of the component
):
    if start + wp.tid() == 0:  # a single thread: the links are taken one after the other
        for k in range(a.shape[0]):
            one = root_of(parent, a[k])
            other = root_of(parent, b[k])
            parent[wp.max(one, other)] = wp.min(one, other)
        for n in range(parent.shape[0]):
            parent[n] = root_of(parent, n)
