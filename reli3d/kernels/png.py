"""The filters of PNG (ISO/IEC 15948, 9): a row becomes what a simple prediction from its neighbours leaves."""

import warp as wp

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": "-march=native"})

# a: the byte of the pixel to the left, b: above, c: above a
RESIDUALS = """
#ifndef __CUDA_ARCH__
typedef unsigned char byte;
auto distance = [](int v) { return v < 0 ? -v : v; };
auto residual = [&](int filter, int x, int a, int b, int c) -> byte {
    if (filter == 1) return (byte)(x - a);
    if (filter == 2) return (byte)(x - b);
    if (filter == 3) return (byte)(x - ((a + b) >> 1));
    if (filter == 4) {
        const int to_a = distance(b - c), to_b = distance(a - c), to_c = distance(a + b - 2 * c);
        return (byte)(x - (to_a <= to_b && to_a <= to_c ? a : to_b <= to_c ? b : c));
    }
    return (byte)x;
};
"""


@wp.func_native(
    RESIDUALS
    + """
const int n = pixels.shape[1];
const byte* row = pixels.data + (size_t)y * n;
const byte* above = y > 0 ? row - n : none.data;
byte* out = rows.data + (size_t)y * (n + 1);
int best = 0;
unsigned least = ~0u;
for (int filter = 0; filter < 5; filter++) {
    unsigned sum = 0;
    auto cost = [&](byte v) { return (unsigned)distance((signed char)v); };
    for (int k = 0; k < bytes; k++) sum += cost(residual(filter, row[k], 0, above[k], 0));
    for (int k = bytes; k < n; k++)
        sum += cost(residual(filter, row[k], row[k - bytes], above[k], above[k - bytes]));
    if (sum < least) { least = sum; best = filter; }
}
out[0] = (byte)best;
for (int filter = 0; filter < 5; filter++) {
    if (filter != best) continue;
    for (int k = 0; k < bytes; k++) out[1 + k] = residual(filter, row[k], 0, above[k], 0);
    for (int k = bytes; k < n; k++)
        out[1 + k] = residual(filter, row[k], row[k - bytes], above[k], above[k - bytes]);
}
#endif
"""
)
def filter_row(pixels: wp.array2d[wp.uint8], none: wp.array[wp.uint8], y: int, bytes: int, rows: wp.array2d[wp.uint8]):
    """The filter of row ``y`` that leaves the least sum of absolute values, and what it leaves."""
    ...


@wp.kernel
def filter_rows_kernel(
    start: int,
    # in
    pixels: wp.array2d[wp.uint8],  # (H, bytes of a row)
    none: wp.array[wp.uint8],  # a row of zeros
    bytes: int,  # of a pixel
    # out
    rows: wp.array2d[wp.uint8],  # (H, bytes of a row + 1)
):
    filter_row(pixels, none, start + wp.tid(), bytes, rows)
