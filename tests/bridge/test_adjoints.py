"""Float32 adjoints against float64 references, 99.9 % of the entries to 1e-4, and these against differences.

Those of the estimator of light, of compositing and of light's lookups are in the tests of these operations.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import pytest
import torch
from torch import Tensor

from reli3d.geometry.hits import interpolate
from reli3d.geometry.mesh import Mesh, face_normals, vertex_normals
from reli3d.geometry.regularize import vertex_deviation
from reli3d.geometry.smooth import taubin_smooth
from reli3d.geometry.surface import CubeWeights, extract_surface
from reli3d.geometry.triplane import sample_triplane
from reli3d.render.asset import TextureSet
from reli3d.render.gaussians import SphericalGaussians, shade_gaussians
from reli3d.render.gbuffer import sample_texture, surface_points
from reli3d.render.material import sample_bsdf
from reli3d.render.sampling import pdf_ggx_vndf
from tests.support import lobes as lobe_kernels
from tests.support import op_cases, reference, reference_surface
from tests.support.meshes import sheet
from tests.support.reference import grid_samples
from tests.support.reference_surface import random_weights, torus
from tests.support.surfaces import on_ball

F = torch.nn.functional
ORDER = ("sdf", "deformation", "alpha", "beta")


@dataclass
class Op:
    """``ours`` and ``in_float64`` take the ``leaves`` in order; the latter takes and gives float64 on the CPU.

    unit: leaves that are unit vectors, of whose gradient only the part across them means something.  one_sign: sums of
    thousands of points, of which some would otherwise cancel.
    """

    leaves: dict[str, Tensor]
    ours: Callable[..., Tensor]
    in_float64: Callable[..., Tensor]
    unit: tuple[str, ...] = ()
    one_sign: bool = False

    def double(self) -> list[Tensor]:
        """Unit vectors made so again: a float32 length errs by 1e-7, which a lobe 0.05 wide sees over its square."""
        exact = {k: F.normalize(v.double(), dim=-1) if k in self.unit else v.double() for k, v in self.leaves.items()}
        return [v.requires_grad_() for v in exact.values()]


def triplane(g) -> Op:
    batch, channels, height, width, count = 2, 40, 96, 128, 20_000
    planes = torch.randn(batch, 3, channels, height, width, generator=g)
    return Op(
        {"planes": planes, "points": torch.rand(batch, count, 3, generator=g) * 2.1 - 1.05},
        sample_triplane,
        grid_samples,
    )


def surface_leaves(g):
    sdf = torus(40) + 0.02 * torch.randn(41, 41, 41, generator=g)
    sdf = F.pad(sdf, (1,) * 6, value=0.7)
    return {"sdf": sdf, **random_weights(sdf.shape, 3, spread=0.5)}


def flexicubes(g) -> Op:
    leaves = surface_leaves(g)
    gamma = leaves.pop("gamma")

    def ours(sdf, alpha, beta, deformation):
        return extract_surface(sdf, radius=0.8, weights=CubeWeights(deformation, alpha, beta, gamma.to(sdf))).vertices

    def in_float64(sdf, alpha, beta, deformation):
        return reference_surface.flexicubes_vertices(sdf, deformation, alpha, beta, 1.6)[0]

    return Op(leaves, ours, in_float64)


def centers(g) -> Op:
    """The vertices that split the quads, of dual vertices that stay."""
    leaves = surface_leaves(g)
    gamma = leaves.pop("gamma")
    fields = CubeWeights(**{k: v for k, v in leaves.items() if k != "sdf"})
    plain = extract_surface(leaves["sdf"], radius=0.8, weights=fields)
    count = len(plain.vertices)

    def ours(gamma):
        near = {k: v.to(gamma) for k, v in leaves.items()}
        weights = CubeWeights(near["deformation"], near["alpha"], near["beta"], gamma)
        return extract_surface(near["sdf"], radius=0.8, weights=weights, center=True).vertices[count:]

    def in_float64(gamma):
        mesh = extract_surface(leaves["sdf"], radius=0.8, weights=fields, center=True)
        quads = mesh.faces.long().view(-1, 4, 3)[:, :, 0]
        cube = reference_surface.flexicubes_vertices(*(leaves[k] for k in ORDER), 1.6)[1]
        corner, weight = mesh.vertices[:count].double()[quads], gamma[cube[quads]]
        one, other = weight[:, 0] * weight[:, 2], weight[:, 1] * weight[:, 3]
        weight = (one / (one + other))[:, None]
        return 0.5 * (weight * (corner[:, 0] + corner[:, 2]) + (1 - weight) * (corner[:, 1] + corner[:, 3]))

    return Op({"gamma": gamma}, ours, in_float64)


def deviation(g) -> Op:
    leaves = surface_leaves(g)
    leaves.pop("gamma")

    def ours(sdf, alpha, beta, deformation):
        return vertex_deviation(sdf, radius=0.8, weights=CubeWeights(deformation, alpha, beta))

    def in_float64(sdf, alpha, beta, deformation):
        return reference_surface.flexicubes_deviation(sdf, deformation, alpha, beta, 1.6)

    return Op(leaves, ours, in_float64)


def on_faces(values, faces, face, bary):
    """Vertex values (V, C) at points of faces, 0 at face -1."""
    a, b, c = values[faces[face.clamp(min=0).long()].long()].unbind(1)
    got = a * (1 - bary.sum(1, keepdim=True)) + b * bary[:, :1] + c * bary[:, 1:]
    return torch.where(face[:, None] >= 0, got, 0.0)


def attributes(g, channels) -> Op:
    vertices, count, rows = 2000, 4000, 30_000
    faces = torch.stack([torch.randperm(vertices, generator=g)[:3] for _ in range(count)]).to(torch.int32)
    face = torch.randint(-1, count, (rows,), generator=g).to(torch.int32)

    def ours(values, bary):
        return interpolate(values, faces.to(bary.device), face.to(bary.device), bary)

    return Op(
        {"values": torch.randn(vertices, channels, generator=g), "bary": op_cases.weights(rows)},
        ours,
        lambda values, bary: on_faces(values, faces, face, bary),
    )


def in_texture(texture, uv):
    at = uv * torch.tensor([texture.shape[1], texture.shape[0]]) - 0.5
    low = at.detach().floor()
    f, (x, y) = at - low, low.long().unbind(-1)
    rows = [[texture[(y + j) % texture.shape[0], (x + i) % texture.shape[1]] for i in (0, 1)] for j in (0, 1)]
    top, bottom = (torch.lerp(one, other, f[:, :1]) for one, other in rows)
    return torch.lerp(top, bottom, f[:, 1:])


def texture(g) -> Op:
    height, width, rows = 96, 64, 30_000
    return Op(
        {"texture": torch.rand(height, width, 3, generator=g), "uv": torch.rand(rows, 2, generator=g) * 3 - 1},
        sample_texture,
        in_texture,
    )


def points_of_a_mesh(g, tangents) -> Op:
    """Everything the shader needs of a hit, from the mesh's arrays, its textures and the place in the face."""
    count, size, rows = 1500, 39, 30_000
    corners = torch.randn(count, 3, 3, generator=g)
    flat = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])

    def about(direction):
        """At each corner, some 15 degrees from the direction of its face."""
        noise = 0.15 * torch.randn(count, 3, 3, generator=g)
        return F.normalize(F.normalize(direction, dim=-1)[:, None] + noise, dim=-1).reshape(-1, 3)

    leaves = {
        "vertices": corners.reshape(-1, 3),
        "normals": about(flat),
        "uv": torch.rand(3 * count, 2, generator=g),
        "tangents": F.pad(about(corners[:, 1] - corners[:, 0]), (0, 1), value=-1.0),
        "base_color": torch.rand(size, size, 3, generator=g),
        **{k: torch.rand(size, size, generator=g) for k in ("roughness", "metallic")},
        "normal": 0.5 + 0.5 * op_cases.above(size * size, 13).reshape(size, size, 3),
        "bary": op_cases.weights(rows),
    }
    # few digits, so that the texture coordinates of points, which are float32, are exact
    leaves |= {k: (leaves[k] * digits).round() / digits for k, digits in (("uv", 4096.0), ("bary", 64.0))}
    if not tangents:
        leaves.pop("tangents")
    faces, face = op_cases.soup(leaves["vertices"], rows)

    def ours(*values):
        v = dict(zip(leaves, values, strict=True))
        on = values[0].device
        mesh = Mesh(v["vertices"], faces.to(on), v["normals"], v["uv"], v.get("tangents"))
        maps = TextureSet(v["base_color"], v["roughness"], v["metallic"], v["normal"])
        found = vars(surface_points(mesh, maps, face.to(on), v["bary"])).values()
        return torch.cat([part.reshape(rows, -1) for part in found], 1)

    def in_float64(*values):
        v = dict(zip(leaves, values, strict=True))
        at = lambda name: on_faces(v[name], faces, face, v["bary"])
        a, b, c = v["vertices"][faces[face.long()].long()].unbind(1)
        n = F.normalize(at("normals"), dim=-1)
        if tangents:
            along, side = at("tangents")[:, :3], -1.0
        else:  # along u, which counts as a constant of the face; the bitangent goes up, against v
            p, q = (leaves[k].double()[faces[face.long()].long()] for k in ("vertices", "uv"))
            edges = torch.stack([p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]], -1)
            moves = torch.linalg.inv(torch.stack([q[:, 1] - q[:, 0], q[:, 2] - q[:, 0]], -1))
            along = (edges @ moves)[..., 0]
            side = -torch.linalg.det(moves).sign()[:, None]
        along = F.normalize(along - (along * n).sum(-1, keepdim=True) * n, dim=-1)
        uv = at("uv")
        bent = in_texture(v["normal"], uv) * 2.0 - 1.0
        bent = bent[:, :1] * along + bent[:, 1:2] * side * torch.linalg.cross(n, along) + bent[:, 2:] * n
        directions = F.normalize(torch.linalg.cross(b - a, c - a), dim=-1), F.normalize(bent, dim=-1)
        finish = v["base_color"], torch.stack([v["roughness"], v["metallic"]], -1)
        return torch.cat([at("vertices"), *directions, *(in_texture(values, uv) for values in finish)], 1)

    return Op(leaves, ours, in_float64)


def density(g) -> Op:
    n = 30_000
    leaves = {"wo": op_cases.above(n, 1), "alpha": torch.rand(n, generator=g) * 0.95 + 0.05, "wm": op_cases.above(n, 3)}
    return Op(leaves, pdf_ggx_vndf, reference.pdf_ggx_vndf, ("wo", "wm"))


def reflections(g, lobe) -> Op:
    n = 30_000
    u = op_cases.numbers(n)
    return Op(
        {"wo": op_cases.above(n, 1), "alpha": torch.rand(n, generator=g) * 0.95 + 0.05},
        lambda wo, alpha: sample_bsdf(wo, alpha, u.to(wo), lobe=lobe),
        lambda wo, alpha: reference.reflected_visible_normal(wo, alpha, u.double(), lobe == "mirrored"),
        ("wo",),
    )


def lobes(g, count):
    return {
        "axis": op_cases.units(count, 4),
        "sharpness": torch.exp(torch.rand(count, generator=g) * 6.0 - 1.0),
        "amplitude": torch.rand(count, 3, generator=g),
    }


def irradiance(g) -> Op:
    leaves = {"normals": op_cases.units(6000, 2), **lobes(g, 24)}
    return Op(
        leaves,
        lambda normals, *light: lobe_kernels.irradiance(SphericalGaussians(*light), normals),
        reference.sg_irradiance,
        ("normals", "axis"),
        one_sign=True,
    )


def gaussians(g) -> Op:
    n = 6000
    normal = op_cases.units(n, 1)
    leaves = {
        "normal": normal,
        "wo": F.normalize(normal + 0.7 * op_cases.units(n, 6), dim=-1),
        "base_color": torch.rand(n, 3, generator=g),
        "roughness": 0.2 + 0.8 * torch.rand(n, generator=g),
        "metallic": torch.rand(n, generator=g),
        **lobes(g, 24),
    }
    return Op(
        leaves,
        lambda *v: shade_gaussians(*on_ball(*v[:5]), SphericalGaussians(*v[5:])),
        lambda normal, wo, base, roughness, *rest: reference.shade_gaussians(normal, wo, base, roughness**2, *rest),
        ("normal", "wo", "axis"),
        one_sign=True,
    )


def normals(g) -> Op:
    mesh = sheet(150)[0]

    def in_float64(vertices):
        a, b, c = (vertices[mesh.faces[:, k].long()] for k in range(3))
        total = torch.zeros_like(vertices)
        for k in range(3):
            total = total.index_add(0, mesh.faces[:, k].long(), torch.linalg.cross(b - a, c - a))
        return F.normalize(total, dim=1)

    return Op({"vertices": mesh.vertices}, lambda v: vertex_normals(v, mesh.faces.to(v.device)), in_float64)


def flat_normals(g) -> Op:
    mesh = sheet(150)[0]

    def in_float64(vertices):
        a, b, c = (vertices[mesh.faces[:, k].long()] for k in range(3))
        return torch.linalg.cross(b - a, c - a)

    return Op({"vertices": mesh.vertices}, lambda v: face_normals(v, mesh.faces.to(v.device)), in_float64)


def smoothing(g) -> Op:
    mesh = sheet(size := 150)[0]
    n = len(mesh.vertices)
    ends = torch.cat([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]]).long()
    ends = torch.cat([ends, ends.flip(1)]).unique(dim=0)
    inner = (mesh.vertices[:, :2] % (size - 1) != 0).all(1)[:, None]
    link = torch.sparse_coo_tensor(ends.T, torch.ones(len(ends), dtype=torch.float64), (n, n), check_invariants=True)
    degree = torch.bincount(ends[:, 0], minlength=n)[:, None]

    def in_float64(vertices):
        for step in (0.5, 1 / (0.1 - 2)) * 3:
            vertices = vertices + step * torch.where(inner, link @ vertices / degree - vertices, 0.0)
        return vertices

    def ours(vertices):
        return taubin_smooth(type(mesh)(vertices, mesh.faces.to(vertices.device)), iterations=3).vertices

    return Op({"vertices": mesh.vertices}, ours, in_float64)


OPS = {
    **{
        f.__name__: f
        for f in (
            triplane,
            flexicubes,
            centers,
            deviation,
            texture,
            normals,
            flat_normals,
            smoothing,
            density,
            irradiance,
            gaussians,
        )
    },
    **{f"attributes {n}": partial(attributes, channels=n) for n in (2, 3, 4)},
    **{f"points {name}": partial(points_of_a_mesh, tangents=name == "tangents") for name in ("tangents", "uv")},
    **{f"reflections {lobe}": partial(reflections, lobe=lobe) for lobe in ("visible", "mirrored")},
}


# the reference of centers starts from vertices of the CPU; each axis of irradiance is a sum of 6000 terms, in any order
ROUNDED_ON_CUDA = {("centers", "cuda"): 1e-3, ("irradiance", "cuda"): 1e-3}


@pytest.mark.parametrize("name", OPS)
def test_the_adjoint_is_that_of_the_float64_reference(device, name):
    """Of the entries that are not 0; those below a hundredth of their median are judged as if they were as large.  No
    kink is left out but the deviation's absolute values, which it takes in float64.
    """
    op, relative = OPS[name](torch.Generator().manual_seed(7)), ROUNDED_ON_CUDA.get((name, device.type), 1e-4)
    double = op.double()
    expected = op.in_float64(*double)
    ours = [v.to(device).requires_grad_() for v in op.leaves.values()]
    got = op.ours(*ours)
    most = max(1.0, 0.1 * float(expected.detach().abs().max()))  # densities go up to hundreds
    torch.testing.assert_close(got.detach().cpu().double(), expected.detach(), rtol=1e-5, atol=2e-6 * most)
    draw = torch.rand if op.one_sign else torch.randn
    cotangent = draw(expected.shape, generator=torch.Generator().manual_seed(8))
    grads = torch.autograd.grad((got * cotangent.to(device)).sum(), ours)
    expected_grads = torch.autograd.grad((expected * cotangent.double()).sum(), double)
    for leaf, a, b in zip(op.leaves, grads, expected_grads, strict=True):
        if leaf in op.unit:
            a, b = (reference.across(v, op.leaves[leaf]) for v in (a, b))
            found = len(b), reference.rows_within(a, b, relative)
        else:
            a, b = a.cpu().double()[b != 0], b[b != 0]
            near = (a - b).abs() <= relative * b.abs().clamp(min=1e-2 * float(b.abs().median()))
            found = len(b), float(near.double().mean())
        assert found[0] >= (24 if op.one_sign else 1000) and found[1] >= 0.999, (leaf, *found)
