"""Straightforward FlexiCubes in plain torch, any dtype, after the paper's equations, and fields to try it on.

The reference for gradients: every cube listed, every edge gathered.  Its grouping of edges walks the
loops on the cube's faces here, independent of the generated tables.
"""

from functools import lru_cache

import torch

CORNERS = [(k & 1, k >> 1 & 1, k >> 2 & 1) for k in range(8)]
EDGES = [(0, 1), (1, 5), (4, 5), (0, 4), (2, 3), (3, 7), (6, 7), (2, 6), (2, 0), (3, 1), (7, 5), (6, 4)]
FACES = [[k for k in range(8) if CORNERS[k][axis] == side] for axis in range(3) for side in range(2)]


@lru_cache(None)
def loops(case, separate=True):
    """Sets of edges that one dual vertex averages; on an ambiguous face inside (else outside) corners stay separate."""
    inside = [bool(case >> k & 1) for k in range(8)]
    links = {e: set() for e, (a, b) in enumerate(EDGES) if inside[a] != inside[b]}
    for face in FACES:
        on = [e for e in links if set(EDGES[e]) <= set(face)]
        for e in on:
            for f in on:
                shared = set(EDGES[e]) & set(EDGES[f])
                if e != f and (len(on) == 2 or (shared and inside[min(shared)] == separate)):
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


@lru_cache(None)
def loop_tables():
    """``(2, 256, 12)`` loop of every crossed edge, -1 elsewhere, outside, then inside corners separate; and the joined
    face of every case or -1.  Loops are numbered as the release does: by their first edge, edges by higher, then lower
    corner.
    """
    table = torch.full((2, 256, 12), -1)
    for separate in (0, 1):
        for case in range(256):
            found = sorted(
                loops(case, bool(separate)), key=lambda loop: min(sorted(EDGES[e], reverse=True) for e in loop)
            )
            for n, loop in enumerate(found):
                table[separate, case, list(loop)] = n
    faces = [joined_face(case) for case in range(256)]
    return table, torch.tensor([-1 if face is None else face for face in faces])


def flexicubes_crossings(sdf, deformation, alpha, beta, tiny=0.0):
    """Crossings ``(E, 3)`` in [-0.5, 0.5], their beta ``(E,)``, dual vertex ``(E,)``, and the cube of every dual vertex
    ``(V,)``, dual vertices in the release's order; inside is sdf < 0.  An edge whose ends are both below ``tiny``
    passes no gradient to them.
    """
    table, face_of = loop_tables()
    shape = sdf.shape
    index = torch.arange(sdf.numel()).view(shape)
    offsets = [tuple(slice(o, n - 1 + o) for o, n in zip(c, shape)) for c in CORNERS]
    cubes = torch.stack([index[o].reshape(-1) for o in offsets], -1)  # (cubes, 8)
    axes = [torch.arange(n, dtype=sdf.dtype) / (n - 1) - 0.5 for n in shape]
    position = torch.stack(torch.meshgrid(*axes, indexing="ij"), -1).view(-1, 3) + deformation.view(-1, 3)
    inside = (sdf.view(-1) < 0)[cubes]
    case = (inside.long() << torch.arange(8)).sum(-1)
    surface = ((case > 0) & (case < 255)).nonzero().squeeze(1)
    own, grid_of = case[surface], case.view([n - 1 for n in shape])
    face = face_of[own]
    at = torch.stack(torch.unravel_index(surface, grid_of.shape), -1)
    axis = (face // 2).clamp(min=0)[:, None]
    at = at.scatter_add(1, axis, torch.where(face % 2 == 1, 1, -1)[:, None])
    ahead = at.gather(1, axis)[:, 0]
    there = (face >= 0) & (ahead >= 0) & (ahead < torch.tensor(grid_of.shape)[axis[:, 0]])
    beyond = face_of[grid_of[tuple(torch.where(there[:, None], at, 0).T)]]
    group = torch.where((there & (beyond == face ^ 1))[:, None], table[0][own], table[1][own])  # (S, 12)
    count = group.amax(1) + 1
    order = torch.argsort(count, stable=True)  # cubes with one dual vertex first
    base = torch.empty_like(count)
    base[order] = count[order].cumsum(0) - count[order]
    row, edge = (group >= 0).nonzero(as_tuple=True)
    ends = torch.tensor(EDGES)[edge]
    corner = cubes[surface][row[:, None], ends]  # (E, 2)
    value = sdf.view(-1)[corner]
    value = torch.where((value.detach().abs().amax(1) < tiny)[:, None], value.detach(), value)
    s, x = value * alpha[surface][row[:, None], ends], position[corner]
    u = (x[:, 0] * s[:, 1:] - x[:, 1] * s[:, :1]) / (s[:, 1:] - s[:, :1])
    cube_of = torch.repeat_interleave(surface[order], count[order])
    return u, beta[surface][row, edge], base[row] + group[row, edge], cube_of


def flexicubes_vertices(sdf, deformation, alpha, beta, scale, tiny=0.0):
    """Dual vertices ``(V, 3)`` in the release's order, and their cubes."""
    u, b, owner, cube_of = flexicubes_crossings(sdf, deformation, alpha, beta, tiny)
    mass = b.new_zeros(len(cube_of)).index_add(0, owner, b)
    return u.new_zeros(len(cube_of), 3).index_add(0, owner, u * (b / mass[owner])[:, None]) * scale, cube_of


def flexicubes_deviation(sdf, deformation, alpha, beta, scale, tiny=0.0):
    """Mean absolute deviation of the distances from a dual vertex to its crossings, ``(V,)``."""
    u, _, owner, cube_of = flexicubes_crossings(sdf, deformation, alpha, beta, tiny)
    vertices = flexicubes_vertices(sdf, deformation, alpha, beta, scale, tiny)[0]
    distance = (vertices[owner] - u * scale).norm(dim=-1)
    none, count = u.new_zeros(len(cube_of)), torch.bincount(owner)
    mean = none.index_add(0, owner, distance) / count
    return none.index_add(0, owner, (distance - mean[owner]).abs()) / count


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
