"""Multiple importance sampling: weights of Veach and Guibas 1995, divided by count and density."""

import warp as wp

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": "-march=native"})


@wp.func
def mis_factor(chosen: float, all: wp.vec4, power: int) -> float:
    """Weight over ``chosen``, the count times density of the strategy that drew the sample; ``all`` holds every
    strategy's.

    Balance heuristic (``power`` 0): 1 / sum, in which the strategy cancels.  Power heuristic (exponent 2):
    chosen / sum of squares, scaled by the sum because the squares of narrow lobes overflow float32.  0 where ``chosen``
    is 0.
    """
    factor = wp.float32(0.0)
    total = all[0] + all[1] + all[2] + all[3]
    if chosen > 0.0:
        factor = 1.0 / total
        if power != 0:
            share = all / total
            factor = chosen / total / (wp.dot(share, share) * total)
    return factor
