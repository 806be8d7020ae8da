"""Nearest site of every texel of a row: the second pass of a Euclidean distance transform."""

from typing import Any

import warp as wp

NO_SITE_ROWS = wp.constant(65536.0)  # rows to the site of a column that has none: beyond any image


@wp.func
def lower_envelope(row: wp.array[Any], y: int, apex: wp.array[wp.int32], begin: wp.array[float]) -> int:
    """Lower envelope of the parabolas ``(x - q)^2 + (row[q] - y)^2`` of the columns q of row ``y``.

    Writes to ``apex`` the columns of the parabolas of the envelope, ascending, and to ``begin`` the x at which each
    becomes the lowest.  Returns the index of the last of them, -1 if there is none.  Felzenszwalb and Huttenlocher
    2012, Distance Transforms of Sampled Functions.

    row: row of the nearest site in each column; in a column without a site, a value at least ``NO_SITE_ROWS`` from
    every row.
    """
    top = wp.int32(-1)
    for q in range(row.shape[0]):
        dy = float(row[q]) - float(y)
        if wp.abs(dy) < 0.5 * NO_SITE_ROWS:
            at = wp.float32(-1.0e30)
            search = top >= 0
            while search:
                v = apex[top]
                other = float(row[v]) - float(y)
                at = ((dy * dy - other * other) / float(q - v) + float(q + v)) * 0.5
                search = at <= begin[top]
                if search:
                    top -= 1
                    if top < 0:
                        at = -1.0e30
                        search = False
            top += 1
            apex[top] = q
            begin[top] = at
    return top
