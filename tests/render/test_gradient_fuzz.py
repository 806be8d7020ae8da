"""A hundred thousand points at the edges of every input: gradients finite everywhere, and where the value is smooth
those of a float64 reference that adds the same samples by the papers' formulas."""

import pytest
import torch
from torch.nn.functional import normalize

from reli3d.geometry.hits import Hits, evaluate_hits, hit_normals, interpolate
from reli3d.geometry.mesh import Mesh
from reli3d.kernels.microfacet import ALPHA_MIN, COS_MIN
from reli3d.kernels.shade import COS_VIEW_MIN
from reli3d.render.asset import TextureSet
from reli3d.render.environment import Environment
from reli3d.render.gbuffer import surface_points
from reli3d.render.material import DIFFUSE_MODELS, eval_bsdf, sample_bsdf
from tests.support import reference
from tests.support.surfaces import at, lit

N = 100_000
EDGES = {"alpha": (0.0, 1e-3, 0.01, 0.1, 1.0), "metallic": (0.0, 1.0, 1e-7, 0.5), "base": (0.0, 1.0, 0.5)}
FLOOR = float(ALPHA_MIN)


def drawn(n, seed=0):
    """Unit normal, geometric normal, view, light ``(n, 3)``; base ``(n, 3)``, alpha, metallic ``(n,)``.

    A quarter of the views, and of the lights, is in the surface, an eighth near it, an eighth exactly above, an
    eighth exactly behind, the rest anywhere above or below; of the parameters half are at an edge, half anywhere.
    """
    g = torch.Generator().manual_seed(seed)
    unit = lambda: normalize(torch.randn(n, 3, generator=g), dim=-1)
    normal, ng, wo, wi = unit(), unit(), unit(), unit()
    for d in (wo, wi):
        kind = torch.randint(8, (n, 1), generator=g)
        flat = normalize(torch.linalg.cross(normal, d), dim=-1)
        d[:] = torch.where(kind < 2, flat, torch.where(kind == 2, normalize(flat + 1e-3 * d, dim=-1), d))
        d[:] = torch.where((kind >= 5) & ((d * normal).sum(-1, keepdim=True) < 0.0), -d, d)
        d[:] = torch.where(kind == 3, normal, torch.where(kind == 4, -normal, d))
    ng = torch.where(torch.rand(n, 1, generator=g) < 0.5, normal, ng)

    def values(edges, *shape):
        edge = torch.tensor(edges)[torch.randint(len(edges), (n, *shape), generator=g)]
        return torch.where(torch.rand(n, *shape, generator=g) < 0.5, edge, torch.rand(n, *shape, generator=g))

    return normal, ng, wo, wi, values(EDGES["base"], 3), values(EDGES["alpha"]), values(EDGES["metallic"])


def frame(n):
    """Rows tangent, bitangent, normal, of the dtype of ``n (N, 3)``; Duff et al. 2017."""
    x, y, z = n.unbind(-1)
    s = torch.where(z < 0.0, -1.0, 1.0).to(n)
    a = -1.0 / (s + z)
    b = x * y * a
    return torch.stack(
        [torch.stack([1 + s * x * x * a, s * b, -s * x], -1), torch.stack([b, s + y * y * a, -y], -1), n], 1
    )


def close(got, expected, fraction, within=2e-3):
    """Whether ``fraction`` of the rows of ``got`` differ by at most ``within`` of their length from ``expected``."""
    got, expected = (v.reshape(len(v), -1).cpu().double() for v in (got, expected))
    off = (got - expected).norm(dim=-1) / (expected.norm(dim=-1) + 1e-5)
    return float((off < within).double().mean()) > fraction


@pytest.mark.parametrize("diffuse_model", DIFFUSE_MODELS)
def test_gradients_of_the_material(device, diffuse_model):
    normal, _, wo, wi, base, alpha, metallic = drawn(N)
    turn = frame(normal)
    local = [(turn @ v[..., None])[..., 0] for v in (wo, wi)]
    leaves = [v.to(device).requires_grad_() for v in (*local, base, alpha, metallic)]
    wo, wi, *material = leaves
    value = eval_bsdf(wo, *material, wi, diffuse_model=diffuse_model)
    weight = torch.rand(N, 3, generator=torch.Generator().manual_seed(1))
    grads = torch.autograd.grad((value * weight.to(device)).sum(), leaves)
    assert bool(torch.isfinite(value).all()) and all(bool(torch.isfinite(g).all()) for g in grads)
    below = (local[0][:, 2] <= 0.0) | (local[1][:, 2] <= 0.0)
    assert all(float(g.cpu()[below].abs().max()) == 0.0 for g in grads)
    # smooth: away from the horizon and above the width's floor
    keep = (local[0][:, 2] > 1e-2) & (local[1][:, 2] > 1e-2) & (alpha >= 0.01)
    assert keep.sum() > 10_000
    in_float64 = [v.detach()[keep].cpu().double().requires_grad_() for v in leaves]
    expected = reference.eval_bsdf(*in_float64, diffuse_model)
    expected_grads = torch.autograd.grad((expected * weight[keep].double()).sum(), in_float64)
    assert close(value.detach()[keep], expected.detach(), 0.999, 1e-5)
    for k, (g, t) in enumerate(zip(grads, expected_grads, strict=True)):
        g = g.cpu()[keep].double()
        if k < 2:  # only the tangent part of a direction's gradient is defined
            g, t = (reference.across(v, in_float64[k]) for v in (g, t))
        assert reference.fraction_within(g, t) >= 0.999, k


def adjusted(normal, ng, wo):
    """The shader's normal: on the viewer's side of the face, adjusted until the view is above its horizon."""
    facing = normal * torch.where((ng * wo).sum(-1, keepdim=True) < 0.0, -1.0, 1.0).to(normal)
    cos = (facing * wo).sum(-1, keepdim=True)
    return torch.where(cos < COS_VIEW_MIN, normalize(facing + wo * (COS_VIEW_MIN - cos), dim=-1), facing)


def in_float64(leaves, ng, wo, draws, density, light, diffuse_model):
    """Radiance ``(N, 3)``: mean over constant directions ``draws`` of value, cosine and ``light`` over ``density``."""
    normal, base, alpha, metallic = leaves
    # a float32 length errs by 1e-7, alpha^2 is 1e-6
    wo, n = normalize(wo, dim=-1), normalize(adjusted(normal, ng, wo), dim=-1)
    turn, out = frame(n.detach())[:, :2], 0.0
    for d, p, radiance in zip(draws, density, light, strict=True):
        d = normalize(d, dim=-1)
        # coordinates of the turning frame: their gradient is that of a rotation that takes the normal along
        cos = [(v * n).sum(-1, keepdim=True) for v in (wo, d)]
        o, i = (torch.cat([(turn @ (v - n * c)[..., None])[..., 0], c], -1) for v, c in zip((wo, d), cos))
        above = i[:, 2:] > COS_MIN
        i = torch.where(above, i, i.new_tensor([0.0, 0.6, 0.8]))
        value = reference.eval_bsdf(o, i, base, alpha.clamp(min=FLOOR), metallic, diffuse_model) * i[:, 2:]
        out = out + torch.where(above, value * radiance / p[:, None].clamp(min=1e-30), 0.0)
    return out / len(draws)


def world_directions(normal, ng, wo, alpha, u):
    """Reflections at visible normals for ``u``, drawn in the shader's frame, and their float64 density."""
    turn = frame(adjusted(normal, ng, wo))
    local, width = (turn @ wo[..., None])[..., 0], alpha.clamp(min=FLOOR)
    d = (turn.mT @ sample_bsdf(local, width, u)[..., None])[..., 0]
    turn = frame(normalize(adjusted(normal.double(), ng.double(), wo.double()), dim=-1))
    o, i = ((turn @ normalize(v.double(), dim=-1)[..., None])[..., 0] for v in (wo, d))
    wm = normalize(o + i, dim=-1)
    pdf = reference.pdf_ggx_vndf(o, width.double(), wm) / (4.0 * (o * wm).sum(-1))
    return d, torch.where(i[:, 2] > COS_MIN, pdf, 0.0)


@pytest.mark.parametrize("diffuse_model", DIFFUSE_MODELS)
@pytest.mark.parametrize("strategy", ["map", "visible"])
def test_gradients_of_the_estimator(device, strategy, diffuse_model):
    """Two samples a point of one strategy, so that the reference can draw them too."""
    normal, ng, wo, _, base, alpha, metallic = drawn(N, 2)
    generator = torch.Generator().manual_seed(3)
    texels = torch.rand(8, 16, 3, generator=generator) ** 3 * 2.0
    seed, count = 7, 2
    draws, density = [], []
    for k in range(count):
        u = reference.random_pairs(N, seed=seed, sample=k, dimension=int(strategy == "visible"))
        d, p = Environment(texels).sample(u) if strategy == "map" else world_directions(normal, ng, wo, alpha, u)
        draws.append(d.double()), density.append(p.double())
    exact = [v.double() for v in (ng, wo)]
    n = adjusted(normal.double(), *exact)
    # no reference where rounding decides which side is seen, if the normal is adjusted, or where to if it points from
    # the view, whether a sample is above
    toward = (exact[0] * exact[1]).sum(-1)
    facing = (toward.abs() > 1e-5) & ((normal.double() * exact[1]).sum(-1) * toward.sign() > -0.9)
    cos_o = (n * exact[1]).sum(-1)
    smooth = facing & ((cos_o - COS_VIEW_MIN).abs() > 1e-5) & (cos_o > 1e-2)
    # a drawn direction errs by 1e-7, its half vector by that over 2 cos_o, of a lobe as wide as alpha
    smooth &= alpha.clamp(min=FLOOR) * cos_o > 3e-4
    for d in draws:
        smooth &= (d * n).sum(-1).abs() > 1e-2
    assert smooth.sum() > N // 5
    leaves = [v.to(device).requires_grad_() for v in (normal, base, alpha, metallic, texels)]
    counts = (count, 0, 0) if strategy == "map" else (0, count, 0)

    def grads(weight):
        points = at(leaves[0].detach(), leaves[0], ng.to(device), wo.to(device), *leaves[1:4])
        options = dict(antithetic="none", sequence="random", alpha="linear", diffuse_model=diffuse_model)
        out = lit(points, Environment(leaves[4]), samples=counts, seed=seed, **options)
        return out.detach(), torch.autograd.grad((out * weight.to(device)).sum(), leaves)

    weight = torch.rand(N, 3, generator=generator)
    value, every = grads(weight)
    assert bool(torch.isfinite(value).all()) and all(bool(torch.isfinite(g).all()) for g in every)
    _, got = grads(torch.where(smooth[:, None], weight, 0.0))
    part = [v.detach().cpu().double()[smooth].requires_grad_() for v in leaves[:4]]
    radiance = texels.double().requires_grad_()
    light = [reference.lookup_envmap(radiance, d[smooth]) for d in draws]
    found = [d[smooth] for d in draws], [p[smooth] for p in density]
    expected = in_float64(part, *(v[smooth] for v in exact), *found, light, diffuse_model)
    *expected_grads, g_texels = torch.autograd.grad((expected * weight.double()[smooth]).sum(), [*part, radiance])
    assert reference.fraction_within(value[smooth], expected) >= 0.999
    wide = alpha[smooth] > 0.3
    for k, (g, t) in enumerate(zip(got, expected_grads)):
        g = g.cpu()[smooth].double()
        if k == 0:
            g, t = (reference.across(v, part[0]) for v in (g, t))
        if strategy == "visible" and k in (0, 2):
            # a lobe's own sample rounds by 1e-7, which its gradients by normal and width divide by alpha^2
            assert close(g, t, 0.99)
            g, t = g[wide], t[wide]
        assert reference.rows_within(g, t) >= 0.999, k
    assert reference.fraction_within(got[4], g_texels) >= 0.999


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"diffuse_model": "published", "heuristic": "power", "sequence": "random"},
        {"antithetic": "mirrored"},
        {"antithetic": "none", "clamp": 0.5},
    ],
)
@pytest.mark.parametrize("light", ["sun", "black"])
def test_all_strategies_together_keep_their_gradients_finite(device, light, options):
    normal, ng, wo, _, base, alpha, metallic = drawn(N, 4)
    texels = torch.zeros(8, 16, 3)
    if light == "sun":
        texels = torch.rand(8, 16, 3, generator=torch.Generator().manual_seed(5)) ** 30 * 1e5
    leaves = [v.to(device).requires_grad_() for v in (normal, base, alpha, metallic, texels)]
    points = at(leaves[0].detach(), leaves[0], ng.to(device), wo.to(device), *leaves[1:4])
    out = lit(points, Environment(leaves[4]), samples=(2, 4, 1), alpha="linear", **options)
    grads = torch.autograd.grad(out.sum(), leaves)
    assert all(bool(torch.isfinite(v).all()) for v in (out, *grads)) and float(out.detach().min()) >= 0.0
    # no light, no gradient except the light's
    assert light == "sun" or all(float(g.abs().max()) == 0.0 for g in grads[:4])
    assert float(grads[4].abs().max()) > 0.0


def slivers(g, count=400):
    """Corners ``(count, 3, 3)`` of triangles up to 1e-7 thin; the first 60 have no area: two corners, or all, in one
    place, or all in a line."""
    corners = torch.rand(count, 3, 3, generator=g) * 2.0 - 1.0
    thin = 10.0 ** (-7.0 * torch.rand(count, 1, generator=g))
    along = torch.rand(count, 1, generator=g)
    corners[:, 2] = corners[:, 0].lerp(corners[:, 1], along).lerp(corners[:, 2], thin)
    corners[:20, 2] = corners[:20, 1]
    corners[20:40] = corners[20:40, :1]
    corners[40:60] = corners[40:60, :1] * torch.tensor([1.0, -3.0, 2.0])[:, None]
    return corners


def weighed(outs, seed=0):
    """All components at random."""
    g = torch.Generator().manual_seed(seed)
    return sum((v * torch.randn(v.shape, generator=g).to(v.device)).sum() for v in outs)


def test_hits_of_slivers_and_of_faces_without_area_have_finite_gradients(device):
    """A hundred thousand rays at points of any face.  A ray query never gives faces without area: these hits are made
    explicitly.  There the evaluation keeps its inputs, and every gradient is 0."""
    g = torch.Generator().manual_seed(6)
    corners = slivers(g)
    faces = torch.arange(corners.numel() // 3, dtype=torch.int32, device=device).reshape(-1, 3)
    aim = torch.randint(len(corners), (N,), generator=g)
    bary = torch.rand(N, 3, generator=g)
    bary /= bary.sum(1, keepdim=True)
    target = (corners[aim] * bary[..., None]).sum(1)
    o = torch.rand(N, 3, generator=g) * 6.0 - 3.0
    o[::7] = target[::7]  # from within the face
    leaves = [v.to(device).requires_grad_() for v in (corners.reshape(-1, 3), o, target - o)]
    hits = Hits(aim.int().to(device), torch.ones(N, device=device), bary[:, 1:].contiguous().to(device))
    again = evaluate_hits(leaves[0], faces, hits, leaves[1], leaves[2])
    normal = hit_normals(leaves[0], faces, hits.face)
    place = interpolate(leaves[0], faces, hits.face, again.bary)
    outs = (again.t, again.bary, place, normal)
    assert all(bool(torch.isfinite(v).all()) for v in outs)
    grads = torch.autograd.grad(weighed(outs), leaves, retain_graph=True)
    assert all(bool(torch.isfinite(v).all()) and float(v.abs().max()) > 0.0 for v in grads)
    flat = (aim < 40).to(device)  # exactly; in a line rounding leaves some of them an area
    assert torch.equal(again.t[flat], hits.t[flat]) and torch.equal(again.bary[flat], hits.bary[flat])
    assert not bool(normal[flat].any())
    none = torch.autograd.grad(weighed(v[flat] for v in (again.t, again.bary, normal)), leaves)
    assert not any(bool(v.any()) for v in none)


def test_shaded_points_of_slivers_have_finite_gradients(device):
    """The whole way from the arrays of a mesh and its textures to light, at a hundred thousand points: faces without
    area in space or in uv, vertex normals that cancel or are 0, tangents along the normal, views from anywhere."""
    g = torch.Generator().manual_seed(7)
    corners = slivers(g).reshape(-1, 3)
    count = len(corners)
    normals, tangents = (normalize(torch.randn(count, 3, generator=g), dim=-1) for _ in range(2))
    uv = torch.rand(count, 2, generator=g) * 4.0 - 2.0
    for k, array in enumerate((normals, tangents, uv)):
        array.view(-1, 3, array.shape[1])[60 + 20 * k : 80 + 20 * k] = 0.0
    normals.view(-1, 3, 3)[120:140, 1:] = -normals.view(-1, 3, 3)[120:140, :1]
    tangents[420:480] = normals[420:480]
    maps = [torch.rand(16, 16, 3, generator=g) for _ in range(3)]
    maps[1][:4], maps[1][4:8], maps[2][:4] = 0.0, 1.0, 0.5  # smooth, rough and metal; no normal
    maps[1:2] = maps[1][..., 1].contiguous(), maps[1][..., 2].contiguous()
    texels = torch.rand(8, 16, 3, generator=g) ** 3 * 2.0
    face = torch.randint(count // 3, (N,), generator=g, dtype=torch.int32).to(device)
    bary = torch.rand(N, 3, generator=g)
    bary[::5, 0] = 0.0
    bary = (bary / bary.sum(1, keepdim=True))[:, 1:].contiguous().to(device)
    wo = normalize(torch.randn(N, 3, generator=g), dim=-1).to(device)
    faces = torch.arange(count, dtype=torch.int32, device=device).reshape(-1, 3)
    signed = torch.nn.functional.pad(tangents, (0, 1), value=1.0)
    for own in (signed, None):
        leaves = [v.to(device).requires_grad_() for v in (corners, normals, uv, *maps, texels)]
        own = None if own is None else own.to(device).requires_grad_()
        points = surface_points(Mesh(leaves[0], faces, leaves[1], leaves[2], own), TextureSet(*leaves[3:7]), face, bary)
        out = lit((points, wo), Environment(leaves[7]), samples=(2, 4, 1))
        leaves += [] if own is None else [own]
        grads = torch.autograd.grad(weighed([*vars(points).values(), out]), leaves)
        for k, v in enumerate((*vars(points).values(), out, *grads)):
            assert bool(torch.isfinite(v).all()) and float(v.detach().abs().max()) > 0.0, k
