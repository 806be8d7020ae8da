"""Connected components of a graph, by sets that grow together (Tarjan 1975): one thread, in the order of the links."""

import warp as wp

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": "-march=native"})


@wp.func
def lowest(parent: wp.array[wp.int32], node: wp.int32) -> wp.int32:
    """Root of the set that ``node`` is in; halves the way to it for the next time."""
    at = wp.int32(node)
    while parent[at] != at:
        parent[at] = parent[parent[at]]
        at = parent[at]
    return at


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
            one = lowest(parent, a[k])
            other = lowest(parent, b[k])
            parent[wp.max(one, other)] = wp.min(one, other)
        for n in range(parent.shape[0]):
            parent[n] = lowest(parent, n)
