"""FlexiCubes as plain torch would have it, written from the paper: the peer of ``extract_surface``.

Cubes are a list, edges are made unique by a sort, every step is a gather or an ``index_add``; torch records the
gradient.  The list of cubes is made once, outside the timed step, as the published release does.
"""

import torch

from reli3d.kernels.flexicubes_tables import tables


def cube_list(shape):
    """Grid vertices of all cubes, ``(N, 8)``."""
    index = torch.arange(shape[0] * shape[1] * shape[2]).view(shape)
    corners = [(k & 1, k >> 1 & 1, k >> 2) for k in range(8)]
    return torch.stack([index[tuple(slice(o, n - 1 + o) for o, n in zip(c, shape))].reshape(-1) for c in corners], -1)


def flexicubes(sdf, deformation, alpha, beta, gamma, cubes, scale):
    """Vertices ``(V, 3)`` and faces ``(F, 3)`` of a field that is positive at the border of its box."""
    table = {name: torch.from_numpy(value).long() for name, value in tables()._asdict().items()}
    size = torch.tensor(sdf.shape) - 1
    values = sdf.reshape(-1)
    inside = (values < 0)[cubes]
    case = (inside.long() << torch.arange(8)).sum(-1)
    surface = ((case > 0) & (case < 255)).nonzero()[:, 0]
    own = case[surface]
    face = table["neighbor"][own]
    stride = torch.stack([size[1] * size[2], size[2], torch.ones_like(size[0])])
    step = torch.where(face >= 0, stride[face // 2] * (face % 2 * 2 - 1), 0)
    place = torch.stack([surface // stride[0], surface // stride[1] % size[1], surface % size[2]], -1)
    ahead = place.gather(1, (face // 2).clamp(min=0)[:, None])[:, 0] + face % 2 * 2 - 1
    valid = (face >= 0) & (ahead >= 0) & (ahead < size[(face // 2).clamp(min=0)])
    other = table["neighbor"][case[torch.where(valid, surface + step, 0)]]
    resolved = torch.where(valid & (other == face ^ 1), 255 - own, own)

    vertex = cubes[surface]
    axes = [torch.arange(n) / (n - 1) - 0.5 for n in sdf.shape]
    position = torch.stack(torch.meshgrid(*axes, indexing="ij"), -1).view(-1, 3) + deformation.view(-1, 3)
    ends = table["ends"]
    pairs = vertex[:, ends]  # (S, 12, 2)
    crossed = inside[surface][:, ends]
    crossed = crossed[..., 0] != crossed[..., 1]
    row, edge = crossed.nonzero(as_tuple=True)
    at = pairs[row, edge]
    s = (values[vertex] * alpha[surface])[row[:, None], ends[edge]]
    x = position[at]
    crossing = (x[:, 0] * s[:, 1:] - x[:, 1] * s[:, :1]) / (s[:, 1:] - s[:, :1])
    count = table["count"][resolved]
    base = count.cumsum(0) - count
    owner = base[row] + table["group"][resolved[row], edge]
    weight = beta[surface][row, edge]
    total = int(count.sum())
    mass = torch.zeros(total).index_add(0, owner, weight)
    vertices = torch.zeros(total, 3).index_add(0, owner, crossing * weight[:, None]) / mass[:, None] * scale

    unique, inverse, times = torch.unique(at.sort(-1).values, dim=0, return_inverse=True, return_counts=True)
    whole = (times == 4)[inverse].nonzero()[:, 0]  # an edge at the box's border has fewer cubes
    order = whole[torch.argsort(inverse[whole], stable=True)].view(-1, 4)
    ring = order[:, [0, 1, 3, 2]]
    quads = owner[ring]
    low, high = unique[inverse[order[:, 0]]].unbind(-1)
    axis = (high - low == 1) * 2 + (high - low == sdf.shape[2])
    flip = ((values[low] < 0) == (axis == 1)).logical_not()
    quads = torch.where(flip[:, None], quads.flip(1), quads)
    g = gamma[surface][row[torch.where(flip[:, None], ring.flip(1), ring)]]
    first = (g[:, 0] * g[:, 2] > g[:, 1] * g[:, 3])[:, None]
    return vertices, torch.where(first, quads[:, [0, 1, 2, 0, 2, 3]], quads[:, [0, 1, 3, 3, 1, 2]]).reshape(-1, 3)
