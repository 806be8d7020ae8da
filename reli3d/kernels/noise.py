"""Solid noise: gradient noise with its exact gradient, summed over octaves, and cellular noise.  Lattice spacing 1."""

import warp as wp

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": "-march=native"})

LACUNARITY = wp.constant(2.03)  # not 2: lattice planes of the octaves must not coincide
SPREAD = wp.constant(2.6)  # brings the standard deviation of one octave to 0.5 (measured: 0.19 without)
INCREMENT = wp.constant(wp.uint32(2891336453))  # of mix(); a literal in a kernel would pass through a signed integer


@wp.func
def mix(h: wp.uint32) -> wp.uint32:
    """Hash of 32 bits: PCG-RXS-M-XS, O'Neill 2014, as in Jarzynski and Olano 2020."""
    state = h * wp.uint32(747796405) + INCREMENT
    word = ((state >> ((state >> wp.uint32(28)) + wp.uint32(4))) ^ state) * wp.uint32(277803737)
    return (word >> wp.uint32(22)) ^ word


@wp.func
def unpack(h: wp.uint32) -> wp.vec3:
    """Three numbers in [-1, 1] of ten bits each."""
    m = wp.uint32(1023)
    return wp.vec3(float(h & m), float((h >> wp.uint32(10)) & m), float((h >> wp.uint32(20)) & m)) * (
        2.0 / 1023.0
    ) - wp.vec3(1.0, 1.0, 1.0)


@wp.func
def gradient_noise(q: wp.vec3, seed: wp.uint32) -> wp.vec4:
    """Value, about [-1, 1], and gradient.  Perlin 2002, Improving Noise: quintic fade; random gradients in a cube."""
    cell = wp.vec3(wp.floor(q[0]), wp.floor(q[1]), wp.floor(q[2]))
    f = q - cell
    s = wp.vec3()
    ds = wp.vec3()
    for k in range(3):
        t = f[k]
        s[k] = t * t * t * (t * (t * 6.0 - 15.0) + 10.0)
        ds[k] = 30.0 * t * t * (t - 1.0) * (t - 1.0)
    value = wp.float32(0.0)
    grad = wp.vec3()
    for i in range(2):
        hx = mix(seed ^ wp.uint32(int(cell[0]) + i))
        wx = wp.where(i == 1, s[0], 1.0 - s[0])
        dx = wp.where(i == 1, ds[0], -ds[0])
        for j in range(2):
            hy = mix(hx + wp.uint32(int(cell[1]) + j))
            wy = wp.where(j == 1, s[1], 1.0 - s[1])
            dy = wp.where(j == 1, ds[1], -ds[1])
            for k in range(2):
                g = unpack(mix(hy + wp.uint32(int(cell[2]) + k)))
                wz = wp.where(k == 1, s[2], 1.0 - s[2])
                dz = wp.where(k == 1, ds[2], -ds[2])
                d = wp.dot(g, f - wp.vec3(float(i), float(j), float(k)))
                w = wx * wy * wz
                value += w * d
                grad += w * g + d * wp.vec3(dx * wy * wz, wx * dy * wz, wx * wy * dz)
    return SPREAD * wp.vec4(value, grad[0], grad[1], grad[2])


@wp.kernel
def fbm_kernel(
    start: int,
    points: wp.array[wp.vec3],
    octaves: int,
    gain: float,
    ridged: int,
    seed: int,
    value: wp.array[float],  # out
    gradient: wp.array[wp.vec3],  # out
):
    i = start + wp.tid()
    q = points[i]
    total = wp.float32(0.0)
    grad = wp.vec3()
    weight = wp.float32(1.0)
    scale = wp.float32(1.0)
    for octave in range(octaves):
        n = gradient_noise(q * scale, mix(wp.uint32(seed * 64 + octave)))
        sign = wp.where(ridged == 1 and n[0] < 0.0, -1.0, 1.0)
        total += sign * weight * n[0]
        grad += (sign * weight * scale) * wp.vec3(n[1], n[2], n[3])
        weight *= gain
        scale *= LACUNARITY
    value[i] = total
    gradient[i] = grad


@wp.kernel
def cells_kernel(
    start: int,
    points: wp.array[wp.vec3],
    seed: int,
    distance: wp.array[wp.vec2],  # out
    cell: wp.array[float],  # out
    gradient: wp.array[wp.vec3],  # out
):
    i = start + wp.tid()
    q = points[i]
    base = wp.vec3(wp.floor(q[0]), wp.floor(q[1]), wp.floor(q[2]))
    first = wp.float32(1.0e9)
    second = wp.float32(1.0e9)
    to_first = wp.vec3()
    to_second = wp.vec3()
    name = wp.uint32(0)
    for x in range(-1, 2):
        for y in range(-1, 2):
            for z in range(-1, 2):
                hx = mix(wp.uint32(seed) ^ wp.uint32(int(base[0]) + x))
                h = mix(mix(hx + wp.uint32(int(base[1]) + y)) + wp.uint32(int(base[2]) + z))
                center = base + wp.vec3(float(x) + 0.5, float(y) + 0.5, float(z) + 0.5) + 0.45 * unpack(h)
                away = q - center
                d = wp.length_sq(away)
                if d < first:
                    second = first
                    to_second = to_first
                    first = d
                    to_first = away
                    name = h
                elif d < second:
                    second = d
                    to_second = away
    first = wp.sqrt(first)
    second = wp.sqrt(second)
    distance[i] = wp.vec2(first, second)
    cell[i] = float(mix(name) >> wp.uint32(8)) * (1.0 / 16777216.0)
    gradient[i] = to_second / wp.max(second, 1.0e-6) - to_first / wp.max(first, 1.0e-6)
