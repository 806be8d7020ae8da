"""Multiple importance sampling: weights of Veach and Guibas 1995, divided by count and density."""

import warp as wp

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": "-march=native"})


@wp.func
def mis_factor(chosen: float, all: wp.vec4, power: int) -> float:
    """MIS weight divided by ``chosen``, the sample count times density of the strategy that drew the sample.

    all: count times density of every strategy, 0 for unused ones.  Balance heuristic (``power`` 0): 1 / sum(all).
    Power heuristic with exponent 2: chosen / sum(all**2), normalized by the sum because the squares of narrow lobes
    overflow float32.  0 if ``chosen`` is 0.
    """
    factor = wp.float32(0.0)
    total = all[0] + all[1] + all[2] + all[3]
    if chosen > 0.0:
        factor = 1.0 / total
        if power != 0:
            fraction = all / total
            factor = chosen / total / (wp.dot(fraction, fraction) * total)
    return factor
