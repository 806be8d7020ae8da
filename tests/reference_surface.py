"""Straightforward FlexiCubes in plain torch, any dtype, after the paper's equations, and fields to try it on.

The truth for gradients: every cube listed, every edge gathered.  Its grouping of edges walks the
loops on the cube's faces here, independent of the generated tables.
"""

from functools import lru_cache

import torch

CORNERS = [(k & 1, k >> 1 & 1, k >> 2 & 1) for k in range(8)]
EDGES = [(0, 1), (1, 5), (4, 5), (0, 4), (2, 3), (3, 7), (6, 7), (2, 6), (2, 0), (3, 1), (7, 5), (6, 4)]
FACES = [[k for k in range(8) if CORNERS[k][axis] == side] for axis in range(3) for side in range(2)]


@lru_cache(None)
def loops(case, apart=True):
    """Sets of edges that one dual vertex averages; on an ambiguous face inside (else outside) corners stay apart."""
    inside = [bool(case >> k & 1) for k in range(8)]
    links = {e: set() for e, (a, b) in enumerate(EDGES) if inside[a] != inside[b]}
    for face in FACES:
        on = [e for e in links if set(EDGES[e]) <= set(face)]
        for e in on:
            for f in on:
                shared = set(EDGES[e]) & set(EDGES[f])
                if e != f and (len(on) == 2 or (shared and inside[min(shared)] == apart)):
                    links[e].add(f)
    found, left = [], set(links)
    while left:
        loop, front = set(), {min(left)}
        while front:
            loop |= front
            front = {f for e in front for f in links[e]} - loop
        found.append(frozenset(loop))
        left -= loop
    return found


def joined_face(case):
    """The ambiguous face both of whose pairs belong to one loop, or None."""
    for n, face in enumerate(FACES):
        on = [e for e, ends in enumerate(EDGES) if set(ends) <= set(face)]
        ambiguous = all((case >> EDGES[e][0] & 1) != (case >> EDGES[e][1] & 1) for e in on)
        if ambiguous and any(set(on) <= loop for loop in loops(case)):
            return n
    return None


def flexicubes_polygons(level, deformation, alpha, beta):
    """``[((cube, loop), crossings (E, 3), their beta (E,)), ...]``; inside is level < 0."""
    shape = level.shape
    index = torch.arange(level.numel()).view(shape)
    offsets = [tuple(slice(o, n - 1 + o) for o, n in zip(c, shape)) for c in CORNERS]
    cubes = torch.stack([index[o].reshape(-1) for o in offsets], -1)  # (cubes, 8)
    axes = [torch.arange(n, dtype=level.dtype) / (n - 1) - 0.5 for n in shape]
    position = torch.stack(torch.meshgrid(*axes, indexing="ij"), -1).view(-1, 3) + deformation.view(-1, 3)
    inside = (level.view(-1) < 0)[cubes]
    case = (inside.long() << torch.arange(8)).sum(-1)
    surface = ((case > 0) & (case < 255)).nonzero().squeeze(1)
    ends = torch.tensor(EDGES)
    s = (level.view(-1)[cubes[surface]] * alpha[surface])[:, ends]  # (S, 12, 2)
    x = position[cubes[surface]][:, ends]  # (S, 12, 2, 3)
    cross = inside[surface][:, ends]
    cross = cross[..., 0] != cross[..., 1]
    weight = torch.where(cross, s[..., 1] - s[..., 0], 1.0)
    u = (x[..., 0, :] * s[..., 1, None] - x[..., 1, :] * s[..., 0, None]) / weight[..., None]
    b = beta[surface]
    grid = case.view([n - 1 for n in shape])
    found = []
    for row, cube in enumerate(surface.tolist()):
        own = int(case[cube])
        face = joined_face(own)
        groups = loops(own)
        if face is not None:
            at = list(torch.unravel_index(torch.tensor(cube), grid.shape))
            at[face // 2] = at[face // 2] + (1 if face % 2 else -1)
            if all(0 <= int(a) < n for a, n in zip(at, grid.shape)) and joined_face(int(grid[tuple(at)])) == face ^ 1:
                groups = loops(own, apart=False)
        for loop in groups:
            e = sorted(loop)
            found.append(((cube, loop), u[row, e], b[row, e]))
    return found


def flexicubes_vertices(level, deformation, alpha, beta, scale):
    """Dual vertices by (cube, loop), ``(V, 3)``, and those keys."""
    polygons = flexicubes_polygons(level, deformation, alpha, beta)
    vertices = torch.stack([(u * b[:, None]).sum(0) / b.sum() for _, u, b in polygons])
    return vertices * scale, [key for key, _, _ in polygons]


def flexicubes_deviation(level, deformation, alpha, beta, scale):
    """Mean absolute deviation of the distances from a dual vertex to its crossings, ``(V,)``."""
    spread = []
    for _, u, b in flexicubes_polygons(level, deformation, alpha, beta):
        distance = ((u - (u * b[:, None]).sum(0) / b.sum()) * scale).norm(dim=-1)
        spread.append((distance - distance.mean()).abs().mean())
    return torch.stack(spread)


def grid(n, radius=1.0, device="cpu"):
    axis = torch.linspace(-radius, radius, n + 1, device=device)
    return torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), -1)


def sphere(n, radius=0.6, device="cpu"):
    return grid(n, device=device).norm(dim=-1) - radius


def torus(n, device="cpu"):
    p = grid(n, device=device)
    return torch.hypot(torch.hypot(p[..., 0], p[..., 1]) - 0.6, p[..., 2]) - 0.22


def random_weights(shape, seed, device="cpu", spread=0.9):
    """Weights over more than the range of the published activations, and deformations of nearly half a cube."""
    rng = torch.Generator().manual_seed(seed)
    n = (shape[0] - 1) * (shape[1] - 1) * (shape[2] - 1)
    made = dict(
        alpha=1 + spread * (2 * torch.rand(n, 8, generator=rng) - 1),
        beta=1 + spread * (2 * torch.rand(n, 12, generator=rng) - 1),
        gamma=0.01 + torch.rand(n, generator=rng),
        deformation=(torch.rand(*shape, 3, generator=rng) - 0.5) * 0.98 / (torch.tensor(shape) - 1),
    )
    return {name: value.to(device) for name, value in made.items()}
