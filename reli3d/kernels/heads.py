"""Small MLPs at points of a triplane on a CPU: the features of a few points and all their layers stay in the cache.

Layers are padded to a ``width`` that is a multiple of 64 and have SiLU between them.  Activations are rows of points.
Numbers are 32-bit words: a float32, or, where ``pack`` is 2, two bfloat16.  Sums, and the last layer of a head, are in
float32.  :mod:`reli3d.nn.packed_heads` puts the weights in the order that is read here.
"""

import warp as wp

from reli3d.kernels.triplane import Sizes, sample_point, vec8

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": "-march=native -mllvm=-inline-threshold=5000"})

GROUP, LANES = 64, 16  # outputs of a layer that lie together, and those of a vector
TILE = wp.constant(48)  # points at a time: a multiple of POINTS, few enough for the cache


@wp.struct
class Heads:
    """MLPs on the same features.

    weights, bias: of the first layers of all heads, then, head by head, of the other hidden layers and the last one.
    """

    inputs: int  # features of a point
    width: int
    pack: int  # numbers in a word
    weights: wp.array[float]
    bias: wp.array[float]
    hidden: wp.array[wp.int32]  # layers of each head
    outputs: wp.array[wp.int32]  # of each head


# Vectors of 16 outputs.  POINTS by VECTORS sums stay in registers: AVX-512 has 32 of a vector each.
SHAPE = (
    """
#ifndef __CUDA_ARCH__
#pragma clang fp contract(fast)
typedef float Lanes __attribute__((vector_size(64), aligned(4)));
typedef int Word __attribute__((may_alias));
typedef int Words __attribute__((vector_size(64), aligned(4), may_alias));
typedef unsigned Bits __attribute__((vector_size(64)));
#if defined(__AVX512BF16__)
typedef __bf16 Pairs __attribute__((vector_size(64)));
#endif
#if defined(__AVX512F__)
constexpr int POINTS = 6, VECTORS = 4;
#else
constexpr int POINTS = 2, VECTORS = 2;
#endif
"""
    + f"constexpr int LANES = {LANES}, GROUP = {GROUP};\n"
)

# x becomes x / (1 + exp(-x)).  2^f of f in [0, 1) is a polynomial of least relative error, 8e-8.
SILU = """{
    Lanes t = x * -1.44269504f;
#if defined(__AVX512DQ__)
    const Lanes f = __builtin_ia32_reduceps512_mask(t, 9, t, (unsigned short)-1, 4);
#else
    t = t < -126.0f ? Lanes{} - 126.0f : t;
    t = t > 126.0f ? Lanes{} + 126.0f : t;
    const Words whole = __builtin_convertvector(t + 127.0f, Words) - 127;
    const Lanes f = t - __builtin_convertvector(whole, Lanes);
#endif
    Lanes e = (((0.001867130087f * f + 0.009017030275f) * f + 0.05579991315f) * f + 0.2401644501f) * f;
    e = (e + 0.6931513118f) * f + 1.0f;
#if defined(__AVX512DQ__)
    e = __builtin_ia32_scalefps512_mask(e, t, e, (unsigned short)-1, 4);
#else
    e = (Lanes)((Words)e + (whole << 23));
#endif
    x = x / (1.0f + e);
}"""

# Two vectors of float32 to one of pairs of bfloat16: the word of a lane holds that lane of both.  Halves round up.
PAIRED = "(Words)((Bits)((Words)low + 32768) >> 16) | (((Words)high + 32768) & -65536)"

MULTIPLY = """
sum[p][v] += one[v] * x[p * stride + k];
"""
MULTIPLY_PAIRS = """
#if defined(__AVX512BF16__)
sum[p][v] = __builtin_ia32_dpbf16ps_512(sum[p][v], (Pairs)one[v], (Pairs)(Words{} + ((const Word*)x)[p * stride + k]));
#else
{
    const Words both = (Words)one[v], other = Words{} + ((const Word*)x)[p * stride + k];
    sum[p][v] += (Lanes)(both << 16) * (Lanes)(other << 16) + (Lanes)(both & -65536) * (Lanes)(other & -65536);
}
#endif
"""
STORE = """
for (int v = 0; v < VECTORS; v++) *(Lanes*)(out + p * stride + v * LANES) = sum[p][v];
"""
STORE_PAIRS = f"""
#pragma clang loop unroll(full)
for (int v = 0; v < VECTORS; v += 2) {{
    const Lanes low = sum[p][v], high = sum[p][v + 1];
    *(Words*)(out + p * stride + v / 2 * LANES) = {PAIRED};
}}
"""


def _dense(multiply: str, store: str, pack: int) -> str:
    return f"""
for (int o = 0; o < width; o += LANES * VECTORS) {{
    const float* group = heads.weights.data + at + o / GROUP * GROUP * inputs + o % GROUP;
    for (int first = 0; first < count; first += POINTS) {{
        Lanes sum[POINTS][VECTORS];
        for (int p = 0; p < POINTS; p++)
            for (int v = 0; v < VECTORS; v++) sum[p][v] = *(const Lanes*)(heads.bias.data + bias_at + o + v * LANES);
        const float *x = from_.data + from_at + first * from_stride, *w = group;
        const int stride = from_stride;
        for (int k = 0; k < inputs; k++, w += GROUP) {{
            Lanes one[VECTORS];
            for (int v = 0; v < VECTORS; v++) one[v] = *(const Lanes*)(w + v * LANES);
            for (int p = 0; p < POINTS; p++)
                for (int v = 0; v < VECTORS; v++) {{ {multiply} }}
        }}
        float* out = to.data + to_at + first * to_stride + o / {pack};
#pragma clang loop unroll(full)
        for (int p = 0; p < POINTS; p++) {{
            const int stride = to_stride;
#pragma clang loop unroll(full)
            for (int v = 0; v < VECTORS; v++) {{
                Lanes& x = sum[p][v];
                {SILU}
            }}
            {store}
        }}
    }}
}}
"""


@wp.func_native(
    f"""{SHAPE}
if (heads.pack == 2) {{ {_dense(MULTIPLY_PAIRS, STORE_PAIRS, 2)} }} else {{ {_dense(MULTIPLY, STORE, 1)} }}
#endif
"""
)
def dense(
    from_: wp.array[float],
    from_at: int,
    from_stride: int,
    inputs: int,  # words of a point
    heads: Heads,
    at: int,  # of the layer's weights, (width / 64, inputs, 64) words
    bias_at: int,
    width: int,
    to: wp.array[float],
    to_at: int,
    to_stride: int,
    count: int,
):
    """A layer and its SiLU for ``count`` points, up to the next multiple of POINTS."""
    ...


@wp.func_native(
    SHAPE
    + """
for (int p = 0; p < count; p++) {
    const float* x = from_.data + from_at + p * stride;
    const float* w = heads.weights.data + at;
    for (int o = 0; o < outputs; o++, w += heads.width) {
        Lanes sum = {};
        for (int k = 0; k < heads.width; k += LANES) {
            Lanes value;
            if (heads.pack == 2) {
                const Words both = *(const Words*)(x + k / 32 * LANES);
                value = (Lanes)(k % 32 ? both & -65536 : both << 16);
            } else
                value = *(const Lanes*)(x + k);
            sum += value * *(const Lanes*)(w + k);
        }
        typedef float Half __attribute__((vector_size(32)));
        typedef float Quarter __attribute__((vector_size(16)));
        const Half half = __builtin_shufflevector(sum, sum, 0, 1, 2, 3, 4, 5, 6, 7)
                        + __builtin_shufflevector(sum, sum, 8, 9, 10, 11, 12, 13, 14, 15);
        const Quarter four = __builtin_shufflevector(half, half, 0, 1, 2, 3)
                           + __builtin_shufflevector(half, half, 4, 5, 6, 7);
        const float total = (four[0] + four[1]) + (four[2] + four[3]);
        *wp::address(out, row + o, first + p) = heads.bias.data[bias_at + o] + total;
    }
}
#endif
"""
)
def last_layer(
    from_: wp.array[float],
    from_at: int,
    stride: int,
    heads: Heads,
    at: int,  # of the layer's weights, (outputs, width) float32
    bias_at: int,
    outputs: int,
    out: wp.array2d[float],
    row: int,
    first: int,
    count: int,
):
    """The last layer of a head for ``count`` points, to the rows of ``out`` from ``row`` on."""
    ...


EVEN, ODD = (", ".join(str(k) for k in range(first, 32, 2)) for first in (0, 1))


@wp.func_native(f"""{SHAPE}
for (int k = 0; k < count; k += 2 * LANES) {{
    const Words a = *(const Words*)(values.data + k), b = *(const Words*)(values.data + k + LANES);
    const Words low = __builtin_shufflevector(a, b, {EVEN}), high = __builtin_shufflevector(a, b, {ODD});
    *(Words*)(values.data + count + k / 2) = {PAIRED};
}}
#endif
""")
def pack_pairs(values: wp.array[float], count: int):
    """Float32 values 0 to ``count``, a multiple of 32, to words of two neighbours, which begin at ``count``."""
    ...


@wp.func_native(f"""{SHAPE}
for (int k = 0; k < width; k += LANES) {{
    Lanes x = *(const Lanes*)(a.data + a_at + k) + *(const Lanes*)(b.data + b_at + k)
            + *(const Lanes*)(c.data + c_at + k);
    {SILU}
    *(Lanes*)(to.data + to_at + k) = x;
}}
#endif
""")
def add_layer(
    a: wp.array[float],
    a_at: int,
    b: wp.array[float],
    b_at: int,
    c: wp.array[float],
    c_at: int,
    width: int,
    to: wp.array[float],
    to_at: int,
):
    """SiLU of the sum of three rows."""
    ...


@wp.func
def other_layers(heads: Heads, hidden: wp.array[float], first: int, count: int, out: wp.array2d[float]):
    """What the heads make of the first activations of ``count`` points, to the columns of ``out`` from ``first`` on.

    hidden: ``2 * TILE`` rows, each with the activations of all heads.  The first ``TILE`` rows hold those of the first
    layer; the others are scratch.
    """
    width = heads.width
    words = width // heads.pack
    stride = heads.hidden.shape[0] * words
    at = heads.hidden.shape[0] * width * heads.inputs // heads.pack
    bias_at = heads.hidden.shape[0] * width
    row = wp.int32(0)
    for h in range(heads.hidden.shape[0]):
        begin = h * words
        for _layer in range(1, heads.hidden[h]):
            to = (begin + TILE * stride) % (2 * TILE * stride)
            dense(hidden, begin, stride, words, heads, at, bias_at, width, hidden, to, stride, count)
            begin = to
            at += width * words
            bias_at += width
        outputs = heads.outputs[h]
        last_layer(hidden, begin, stride, heads, at, bias_at, outputs, out, row, first, count)
        at += width * outputs
        bias_at += outputs
        row += outputs


@wp.kernel
def point_heads_kernel(
    start: int,
    # in
    begin: int,
    planes: wp.array[vec8],
    points: wp.array[wp.vec3],
    sizes: Sizes,
    heads: Heads,
    # scratch
    features: wp.array[vec8],  # of TILE points
    values: wp.array[float],  # the same memory as ``features``, and as much scratch after it
    hidden: wp.array[float],
    # out
    out: wp.array2d[float],
):
    """A thread is ``TILE`` points; those of one launch follow each other, since they share the scratch."""
    first = (begin + start + wp.tid()) * TILE
    count = wp.min(TILE, points.shape[0] - first)
    for p in range(count):
        for plane in range(3):
            sample_point(planes, points[first + p], plane, sizes, 0, 1, features, (p * 3 + plane) * sizes.blocks)
    at = wp.int32(0)
    if heads.pack == 2:
        at = TILE * heads.inputs
        pack_pairs(values, at)
    words = heads.inputs // heads.pack
    every = heads.hidden.shape[0] * heads.width
    dense(values, at, words, words, heads, 0, 0, every, hidden, 0, every // heads.pack, count)
    other_layers(heads, hidden, first, count, out)


@wp.kernel
def grid_heads_kernel(
    start: int,
    # in
    begin: int,
    of_xy: wp.array[float],  # (n, n, width) what the first layer makes of the features of each plane, with its bias
    of_xz: wp.array[float],
    of_yz: wp.array[float],
    n: int,
    heads: Heads,  # one, in float32
    # scratch
    hidden: wp.array[float],
    # out
    out: wp.array2d[float],
):
    """A thread is a line along z of a grid of ``n`` points a side; those of one launch follow each other."""
    line = begin + start + wp.tid()
    i = line // n
    j = line % n
    width = heads.width
    for first in range(0, n, TILE):
        count = wp.min(TILE, n - first)
        for p in range(count):
            k = first + p
            add_layer(
                of_xy, line * width, of_xz, (i * n + k) * width, of_yz, (j * n + k) * width, width, hidden, p * width
            )
        other_layers(heads, hidden, line * n + first, count, out)
