"""Float32 adjoints of the geometry and its textures against float64 twins: 999 entries in a thousand to 1e-4."""

from collections.abc import Callable
from dataclasses import dataclass

import pytest
import torch
from torch import Tensor

from reli3d.geometry.mesh import face_normals, vertex_normals
from reli3d.geometry.regularize import vertex_deviation
from reli3d.geometry.smooth import taubin_smooth
from reli3d.geometry.surface import extract_surface
from reli3d.render.gbuffer import interpolate, sample_texture
from reli3d.triplane import sample_triplane
from tests import reference_surface
from tests.reference_surface import random_weights, torus
from tests.test_smooth import sheet
from tests.test_triplane import twin as grid_samples

F = torch.nn.functional
ORDER = ("level", "deformation", "alpha", "beta")


@dataclass
class Op:
    """``ours`` and ``twin`` take the ``leaves`` in order; the twin takes and gives float64 on the CPU."""

    leaves: dict[str, Tensor]
    ours: Callable[..., Tensor]
    twin: Callable[..., Tensor]


def triplane(g) -> Op:
    planes = torch.randn(2, 3, 40, 96, 128, generator=g)
    return Op({"planes": planes, "points": torch.rand(2, 20_000, 3, generator=g) * 2.1 - 1.05}, sample_triplane,
              grid_samples)  # fmt: skip


def surface_leaves(g):
    level = F.pad(torus(40) + 0.02 * torch.randn(41, 41, 41, generator=g), (1,) * 6, value=0.7)
    return {"level": level, **random_weights(level.shape, 3, spread=0.5)}


def flexicubes(g) -> Op:
    leaves = surface_leaves(g)
    gamma = leaves.pop("gamma")

    def ours(level, alpha, beta, deformation):
        return extract_surface(level, radius=0.8, alpha=alpha, beta=beta, deformation=deformation,
                               gamma=gamma.to(level)).vertices  # fmt: skip

    def twin(level, alpha, beta, deformation):
        return reference_surface.flexicubes_vertices(level, deformation, alpha, beta, 1.6)[0]

    return Op(leaves, ours, twin)


def centres(g) -> Op:
    """The vertices that split the quads, of dual vertices that stay."""
    leaves = surface_leaves(g)
    gamma = leaves.pop("gamma")
    plain = extract_surface(leaves["level"], radius=0.8, **{k: v for k, v in leaves.items() if k != "level"})
    count = len(plain.vertices)

    def ours(gamma):
        fields = {k: v.to(gamma) for k, v in leaves.items()}
        return extract_surface(fields.pop("level"), radius=0.8, gamma=gamma, centre=True, **fields).vertices[count:]

    def twin(gamma):
        fields = {k: v for k, v in leaves.items() if k != "level"}
        mesh = extract_surface(leaves["level"], radius=0.8, centre=True, **fields)
        quads = mesh.faces.long().view(-1, 4, 3)[:, :, 0]
        cube = reference_surface.flexicubes_vertices(*(leaves[k] for k in ORDER), 1.6)[1]
        corner, weight = mesh.vertices[:count].double()[quads], gamma[cube[quads]]
        one, other = weight[:, 0] * weight[:, 2], weight[:, 1] * weight[:, 3]
        share = (one / (one + other))[:, None]
        return 0.5 * (share * (corner[:, 0] + corner[:, 2]) + (1 - share) * (corner[:, 1] + corner[:, 3]))

    return Op({"gamma": gamma}, ours, twin)


def deviation(g) -> Op:
    leaves = surface_leaves(g)
    leaves.pop("gamma")

    def ours(level, alpha, beta, deformation):
        return vertex_deviation(level, radius=0.8, alpha=alpha, beta=beta, deformation=deformation)

    def twin(level, alpha, beta, deformation):
        return reference_surface.flexicubes_deviation(level, deformation, alpha, beta, 1.6)

    return Op(leaves, ours, twin)


def attributes(g) -> Op:
    faces = torch.stack([torch.randperm(2000, generator=g)[:3] for _ in range(4000)]).to(torch.int32)
    face = torch.randint(-1, 4000, (30_000,), generator=g).to(torch.int32)
    weight = torch.rand(30_000, 3, generator=g)
    bary = (weight / weight.sum(1, keepdim=True))[:, 1:].contiguous()

    def ours(values, bary):
        return interpolate(values, faces.to(bary.device), face.to(bary.device), bary)

    def twin(values, bary):
        a, b, c = values[faces[face.clamp(min=0).long()].long()].unbind(1)
        got = a * (1 - bary.sum(1, keepdim=True)) + b * bary[:, :1] + c * bary[:, 1:]
        return torch.where(face[:, None] >= 0, got, 0.0)

    return Op({"values": torch.randn(2000, 3, generator=g), "bary": bary}, ours, twin)


def texture(g) -> Op:
    def twin(texture, uv):
        at = uv * torch.tensor([texture.shape[1], texture.shape[0]]) - 0.5
        low = at.detach().floor()
        f, (x, y) = at - low, low.long().unbind(-1)
        rows = [[texture[(y + j) % texture.shape[0], (x + i) % texture.shape[1]] for i in (0, 1)] for j in (0, 1)]
        top, bottom = (torch.lerp(one, other, f[:, :1]) for one, other in rows)
        return torch.lerp(top, bottom, f[:, 1:])

    return Op({"texture": torch.rand(96, 64, 3, generator=g), "uv": torch.rand(30_000, 2, generator=g) * 3 - 1},
              sample_texture, twin)  # fmt: skip


def normals(g) -> Op:
    mesh = sheet(150)[0]

    def twin(vertices):
        a, b, c = (vertices[mesh.faces[:, k].long()] for k in range(3))
        total = torch.zeros_like(vertices)
        for k in range(3):
            total = total.index_add(0, mesh.faces[:, k].long(), torch.linalg.cross(b - a, c - a))
        return F.normalize(total, dim=1)

    return Op({"vertices": mesh.vertices}, lambda v: vertex_normals(v, mesh.faces.to(v.device)), twin)


def flat_normals(g) -> Op:
    mesh = sheet(150)[0]

    def twin(vertices):
        a, b, c = (vertices[mesh.faces[:, k].long()] for k in range(3))
        return torch.linalg.cross(b - a, c - a)

    return Op({"vertices": mesh.vertices}, lambda v: face_normals(v, mesh.faces.to(v.device)), twin)


def smoothing(g) -> Op:
    mesh = sheet(150)[0]
    n = len(mesh.vertices)
    ends = torch.cat([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]]).long()
    ends = torch.cat([ends, ends.flip(1)]).unique(dim=0)
    inner = (mesh.vertices[:, :2] % 149 != 0).all(1)[:, None]
    link = torch.sparse_coo_tensor(ends.T, torch.ones(len(ends), dtype=torch.float64), (n, n), check_invariants=True)
    degree = torch.bincount(ends[:, 0], minlength=n)[:, None]

    def twin(vertices):
        for step in (0.5, 1 / (0.1 - 2)) * 3:
            vertices = vertices + step * torch.where(inner, link @ vertices / degree - vertices, 0.0)
        return vertices

    def ours(vertices):
        return taubin_smooth(type(mesh)(vertices, mesh.faces.to(vertices.device)), iterations=3).vertices

    return Op({"vertices": mesh.vertices}, ours, twin)


OPS = (triplane, flexicubes, centres, deviation, attributes, texture, normals, flat_normals, smoothing)


@pytest.fixture(params=OPS, ids=lambda make: make.__name__, scope="module")
def op(request) -> Op:
    return request.param(torch.Generator().manual_seed(7))


@pytest.mark.parametrize("make", OPS, ids=lambda make: make.__name__)
def test_the_adjoint_is_that_of_the_float64_twin(device, make):
    """Of the entries that are not 0; those below a hundredth of their median are judged as if they were as large.  No
    kink is left out but the deviation's absolute values, which it takes in float64.
    """
    op = make(torch.Generator().manual_seed(7))
    double = [v.double().requires_grad_() for v in op.leaves.values()]
    want = op.twin(*double)
    ours = [v.to(device).requires_grad_() for v in op.leaves.values()]
    got = op.ours(*ours)
    torch.testing.assert_close(got.detach().cpu().double(), want.detach(), rtol=1e-5, atol=2e-6)
    share = torch.randn(want.shape, generator=torch.Generator().manual_seed(8))
    grads = torch.autograd.grad((got * share.to(device)).sum(), ours)
    truth = torch.autograd.grad((want * share.double()).sum(), double)
    for name, a, b in zip(op.leaves, grads, truth, strict=True):
        a, b = a.cpu().double()[b != 0], b[b != 0]
        near = (a - b).abs() <= 1e-4 * b.abs().clamp(min=1e-2 * float(b.abs().median()))
        assert len(b) > 1000 and float(near.double().mean()) >= 0.999, (name, float(near.double().mean()))
