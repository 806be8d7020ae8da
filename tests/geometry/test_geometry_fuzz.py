"""A hundred thousand cubes, points and faces at the edges of every input of the geometry kernels: values and gradients
finite everywhere, and equal to a float64 reference wherever that is unique."""

import math

import pytest
import torch
from torch.nn.functional import normalize

from reli3d.geometry.bake import Texels, bake
from reli3d.geometry.camera import Camera
from reli3d.geometry.hull import hull_distance
from reli3d.geometry.mesh import Mesh, vertex_normals
from reli3d.geometry.regularize import vertex_deviation
from reli3d.geometry.smooth import taubin_smooth
from reli3d.geometry.surface import CubeWeights, extract_surface
from reli3d.geometry.tangents import encode_normals
from reli3d.geometry.triplane import sample_triplane
from reli3d.kernels.flexicubes import SDF_MIN
from tests.support import reference_surface
from tests.support.reference import decode_normals

N = 100_000
CUBES = 47  # a side: 103,823 cubes
# Of the change by a relative step of an input, where an edge of 0.02 and a random fraction of 1 give up to 0.02: digits
# that float32 lacks where terms of that size cancel, and float64 in differences of fractions.  Centers are
# means of vertices that are rounded in the box of 1, not in a cube.
FLOOR = {"sdf": 3e-9, "deformation": 1e-9, "alpha": 3e-9, "beta": 3e-9, "gamma": 1e-7}


def agree(got, expected, floor=0.0, fraction=0.999, within=1e-4):
    """Whether a ``fraction`` of ``got`` has a relative error of at most ``within``, or an absolute one of ``floor``."""
    off = (got.detach().cpu().double() - expected.detach()).abs() - within * expected.detach().abs()
    return float((off <= floor).double().mean()) >= fraction


def finite(*tensors):
    return all(bool(torch.isfinite(t).all()) for t in tensors)


def wild(shape, generator):
    """Numbers of every size: ordinary, equal, zero of both signs, denormal, near 1e-30, up to 3e38; any sign."""
    kind = torch.randint(8, shape, generator=generator)
    sign = torch.where(torch.rand(shape, generator=generator) < 0.5, -1.0, 1.0)
    sized = torch.rand(shape, generator=generator) + 0.01
    power = torch.tensor([0.0, 0.0, 0.0, -45.0, -39.0, -30.0, 30.0, 38.0], dtype=torch.float64)[kind]
    value = torch.where(kind < 2, sized, torch.where(kind == 2, 0.5, 0.0)).double() + (kind > 3) * sized * 10.0**power
    return (sign * torch.where(kind == 3, 2.0**-149, value).clamp(max=3.4e38)).float() * (kind != 4)


def wild_weights(shape, generator, reach):
    """Positive numbers, half of them at the ends of the published activation, some ``10 ** +-reach``."""
    ends = torch.tensor([0.5, 1.5, 1.0, 10.0**reach, 10.0**-reach])
    pick = ends[torch.randint(5 if reach else 3, shape, generator=generator)]
    return torch.where(torch.rand(shape, generator=generator) < 0.5, pick, torch.rand(shape, generator=generator) + 0.5)


def wild_fields(generator, reach):
    """A field with all its weights, outside at the border: no padding, which the reference lacks."""
    sdf, n = wild((CUBES + 1,) * 3, generator), CUBES**3
    for axis in range(3):
        sdf.select(axis, 0).abs_(), sdf.select(axis, -1).abs_()
    return {
        "sdf": sdf,
        "deformation": (torch.randint(3, (*sdf.shape, 3), generator=generator) - 1) * (0.49 / CUBES),
        "alpha": wild_weights((n, 8), generator, reach),
        "beta": wild_weights((n, 12), generator, reach),
        "gamma": wild_weights((n,), generator, reach),
    }


@pytest.mark.parametrize("reach", [0, 6])
def test_gradients_of_flexicubes(device, reach):
    """``reach``: the published activations' range, then all that is allowed."""
    g = torch.Generator().manual_seed(reach)
    leaves = wild_fields(g, reach)
    ours = {k: v.to(device).requires_grad_() for k, v in leaves.items()}
    weights = CubeWeights(**{k: ours[k] for k in leaves if k != "sdf"})
    mesh = extract_surface(ours["sdf"], radius=0.5, center=True, weights=weights)
    cotangent = torch.randn(mesh.vertices.shape, generator=g)
    got = torch.autograd.grad((mesh.vertices * cotangent.to(device)).sum(), list(ours.values()))
    assert finite(mesh.vertices, *got)
    double = {k: v.double().requires_grad_() for k, v in leaves.items()}
    dual, cube_of = reference_surface.flexicubes_vertices(
        *(double[k] for k in ("sdf", "deformation", "alpha", "beta")), 1.0, SDF_MIN
    )
    quads = mesh.faces.cpu().long().view(-1, 4, 3)[:, :, 0]
    corner, weight = dual[quads], double["gamma"][cube_of[quads]]
    one, other = weight[:, 0] * weight[:, 2], weight[:, 1] * weight[:, 3]
    middle = (corner[:, 0] + corner[:, 2]) * one[:, None] + (corner[:, 1] + corner[:, 3]) * other[:, None]
    expected = torch.cat([dual, middle * (0.5 / (one + other))[:, None]])
    assert len(dual) > N and len(expected) == len(mesh.vertices)
    # a sum of twelve points of size 0.5; with weights of any size it has the same terms
    torch.testing.assert_close(mesh.vertices.detach().cpu().double(), expected.detach(), rtol=0, atol=5e-7)
    true = torch.autograd.grad((expected * cotangent.double()).sum(), list(double.values()))
    for name, a, b in zip(leaves, got, true, strict=True):
        size = 1.0 if name == "deformation" else leaves[name].double().abs().clamp(min=1e-30)
        assert agree(a, b, FLOOR[name] / size + 1e-37), name  # the least float32 number with all its digits


@pytest.mark.parametrize("reach", [0, 6])
def test_gradients_of_the_deviation(device, reach):
    leaves = list(wild_fields(torch.Generator().manual_seed(10 + reach), reach).values())[:4]
    ours = [v.to(device).requires_grad_() for v in leaves]
    spread = vertex_deviation(ours[0], radius=0.5, weights=CubeWeights(*ours[1:]))
    assert len(spread) > N and finite(spread, *torch.autograd.grad(spread.sum(), ours))
    expected = reference_surface.flexicubes_deviation(*(v.double() for v in leaves), 1.0)
    # differences of positions in the box of 1; their absolute values have kinks, so no reference has all gradients
    torch.testing.assert_close(spread.detach().cpu().double(), expected, rtol=0, atol=3e-7)


EDGE = (1.0, -1.0, 1.0 + 1e-7, -1.0 - 1e-7, 0.0, -0.0, 1e-40, 2.0, -1e30, 3e38)
PLANES = [(torch.float32, 40, 33, 21), (torch.float16, 13, 16, 8), (torch.bfloat16, 8, 5, 64)]


@pytest.mark.parametrize("dtype, channels, height, width", PLANES)
def test_gradients_of_the_triplane(device, dtype, channels, height, width):
    g = torch.Generator().manual_seed(channels)
    stored = torch.randn(1, 3, channels, height, width, generator=g).to(dtype)
    size = torch.tensor([width, height, width, height], dtype=torch.float64)
    points = torch.rand(N, 3, generator=g) * 2.4 - 1.2
    kind = torch.randint(8, (N, 3), generator=g)
    step = size[torch.randint(4, (N, 3), generator=g)]
    texel = torch.floor(torch.rand(N, 3, generator=g) * (step + 2)) - 1
    points = torch.where(kind == 0, (2 * texel / step - 1).float(), points)  # borders of texels
    points = torch.where(kind == 1, (2 * (texel + 0.5) / step - 1).float(), points)  # their centers
    points = torch.where(kind == 2, torch.tensor(EDGE)[torch.randint(len(EDGE), (N, 3), generator=g)], points)
    points[: N // 50, 0], points[N // 50 : N // 25, 1], points[N // 25 : N // 20, 2] = math.nan, math.inf, -math.inf
    weights = torch.rand(1, N, 3 * channels, generator=g)  # of one sign: sums that cancel have no digits to compare
    planes, at = stored.to(device).requires_grad_(), points[None].to(device).requires_grad_()
    out = sample_triplane(planes, at)
    g_planes, g_points = torch.autograd.grad((out * weights.to(device)).sum(), (planes, at))
    assert finite(out, g_planes, g_points) and g_planes.dtype == dtype
    nowhere = ~torch.isfinite(points)
    assert float(g_points.cpu()[0][nowhere].abs().max()) == 0.0  # a coordinate at no place
    p, q = stored.double().requires_grad_(), torch.where(nowhere, 9.0, points).double().requires_grad_()
    parts, smooth = [], torch.ones(N, 3, dtype=torch.bool)
    for k, axes in enumerate(([0, 1], [0, 2], [1, 2])):
        got = torch.nn.functional.grid_sample(p[:, k], q[None, None, :, axes], align_corners=False)
        parts.append(got[0, :, 0].T)
        # at a texel's center the gradient jumps, and float32 decides on which side a point is
        coordinate = (q.detach()[:, axes] + 1) * torch.tensor([width, height]) / 2 - 0.5
        distance = (coordinate - coordinate.round()).abs()
        smooth[:, axes] &= (distance > 1e-4) | (distance.isnan())
    expected = torch.cat(parts, 1)
    # a coordinate of up to 64 texels rounds by 4e-6 of one; values differ by up to 8 from texel to texel
    torch.testing.assert_close(out.detach().cpu()[0].double(), expected.detach(), rtol=0, atol=8 * 4e-6)
    t_planes, t_points = torch.autograd.grad((expected * weights[0].double()).sum(), (p, q))
    assert agree(
        g_planes, t_planes, within={torch.float32: 1e-4, torch.float16: 2.0**-10, torch.bfloat16: 2.0**-7}[dtype]
    )
    smooth &= ~nowhere
    assert smooth.sum() > N
    # gradients change from texel to texel by their own size, and the coordinate errs by 4e-6 of one
    assert agree(g_points.cpu()[0][smooth], t_points[smooth], 4e-6 * t_points[smooth].abs().mean())


def wild_faces(generator, largest):
    """Corners ``(N, 3, 3)``: triangles of 1e-3 to ``largest``, a third of them thin, folded up, or without any area."""
    corners = torch.rand(N, 3, 3, generator=generator) * 2 - 1
    kind = torch.randint(12, (N, 1), generator=generator)
    along, thin = torch.rand(N, 1, generator=generator), 10.0 ** (-9 * torch.rand(N, 1, generator=generator))
    flat = corners[:, 0].lerp(corners[:, 1], along)
    third = torch.where(kind == 0, flat.lerp(corners[:, 2], thin), corners[:, 2])
    third = torch.where(kind == 1, flat, torch.where(kind == 2, corners[:, 0], third))
    corners[:, 2] = torch.where(kind == 3, corners[:, 0] + 1e-30, third)
    scale = 10.0 ** (torch.rand(N, 1, 1, generator=generator) * (math.log10(largest) + 3) - 3)
    return corners * scale, (kind > 3).squeeze(1)


def test_gradients_of_normals(device):
    g = torch.Generator().manual_seed(20)
    corners, sound = wild_faces(g, 1e9)
    faces = torch.arange(3 * N, dtype=torch.int32).view(-1, 3)
    cotangent = torch.randn(3 * N, 3, generator=g)
    leaf = corners.view(-1, 3).to(device).requires_grad_()
    normals = vertex_normals(leaf, faces.to(device))
    (got,) = torch.autograd.grad((normals * cotangent.to(device)).sum(), leaf)
    assert finite(normals, got)
    torch.testing.assert_close(normals.detach().norm(dim=1).cpu(), torch.ones(3 * N), rtol=0, atol=1e-6)
    double = corners.view(-1, 3).double().requires_grad_()
    a, b, c = double.view(-1, 3, 3).unbind(1)
    cross = torch.linalg.cross(b - a, c - a)
    (expected,) = torch.autograd.grad(
        (normalize(cross, dim=1).repeat_interleave(3, 0) * cotangent.double()).sum(), double
    )
    length = (b - a).norm(dim=1) * (c - a).norm(dim=1)
    # a float32 cross product errs by 1e-7 of its sides' product: by 1e-5 of one that is a hundred times smaller
    plain = (sound & (cross.norm(dim=1) > 0.01 * length)).detach()
    plain &= corners.abs().amax((1, 2)) < 1e5  # above it the inverse cube of a squared length leaves float32
    assert plain.sum() > N // 3
    row = (got.cpu().double() - expected).view(N, 9).norm(dim=1) / expected.view(N, 9).norm(dim=1)
    assert float((row[plain] < 1e-4).double().mean()) > 0.999
    # smoothing is linear: an edge of no length or a face of no area changes nothing about it
    moved = taubin_smooth(Mesh(leaf, faces.to(device)), iterations=1).vertices
    assert finite(moved, *torch.autograd.grad(moved.sum(), leaf))


def test_tangents_and_normal_maps(device):
    """Tangents have no gradient; unit, orthogonal and w = +-1 whatever the faces and their UV are."""
    g = torch.Generator().manual_seed(21)
    corners, _ = wild_faces(g, 1e4)
    uv = torch.rand(N, 3, 2, generator=g)
    kind = torch.randint(6, (N, 1), generator=g)
    uv[:, 2] = torch.where(kind == 0, uv[:, 0], torch.where(kind == 1, uv[:, 0].lerp(uv[:, 1], 0.3), uv[:, 2]))
    uv = torch.where((kind == 2)[..., None], uv * 1e-30, uv)
    faces = torch.arange(3 * N, dtype=torch.int32).view(-1, 3)
    mesh = Mesh(corners.view(-1, 3), faces, uv=uv.view(-1, 2)).to(device).with_normals()
    tangent = mesh.with_tangents().tangents
    assert finite(tangent) and bool((tangent[:, 3].abs() == 1).all())
    assert float((tangent[:, :3].norm(dim=1) - 1).abs().max()) < 1e-6
    assert float((tangent[:, :3] * mesh.normals).sum(1).abs().max()) < 2e-6  # of a float32 normal
    # interpolated frames of any angle, down to a tangent along the normal and ones that cancel
    world = normalize(torch.randn(N, 3, generator=g), dim=1)
    normal = normalize(torch.randn(N, 3, generator=g), dim=1)
    direction = normalize(torch.randn(N, 3, generator=g), dim=1)
    kind = torch.randint(6, (N, 1), generator=g)
    direction = torch.where(kind == 0, normal, torch.where(kind == 1, 0.0, direction))
    world = torch.where(kind == 2, -normal, torch.where(kind == 3, normal, world))
    frame = torch.cat([direction, torch.where(torch.rand(N, 1, generator=g) < 0.5, -1.0, 1.0)], 1).to(device)
    leaf = world.to(device).requires_grad_()
    encoded = encode_normals(leaf, normal.to(device), frame)
    assert finite(encoded, *torch.autograd.grad(encoded.sum(), leaf))
    code = encoded.detach().requires_grad_()
    decoded = decode_normals(code, normal.to(device), frame)
    assert finite(decoded, *torch.autograd.grad(decoded.sum(), code))
    # not below the surface, where a normal is adjusted to it, and a frame that is one
    plain = (encoded.detach().cpu()[:, 2] > 0.51) & (torch.linalg.cross(normal, direction).norm(dim=1) > 0.1)
    assert plain.sum() > N // 5
    torch.testing.assert_close(decoded.detach().cpu()[plain], world[plain], rtol=0, atol=1e-4)


def test_interpolation_of_texels(device):
    """Attributes at texels of degenerate faces, weights at corners and edges; values alone, baking passes no
    gradient."""
    g = torch.Generator().manual_seed(22)
    corners, _ = wild_faces(g, 1e4)
    faces = torch.arange(3 * N, dtype=torch.int32).view(-1, 3)
    mesh = Mesh(corners.view(-1, 3), faces, uv=torch.rand(3 * N, 2, generator=g)).with_normals()
    opposite = mesh.normals.view(N, 3, 3).clone()
    opposite[::7, 1] = -opposite[::7, 0]  # cancel in the middle of an edge
    tangent = torch.cat([normalize(torch.randn(3 * N, 3, generator=g), dim=1), torch.ones(3 * N, 1)], 1).view(N, 3, 4)
    tangent[::5, 1, :3] = -tangent[::5, 0, :3]
    mesh = Mesh(mesh.vertices, faces, opposite.view(-1, 3), mesh.uv, tangent.view(-1, 4)).to(device)
    size = math.isqrt(N)
    bary = torch.distributions.Dirichlet(torch.ones(3)).sample((size * size,))[:, 1:]
    corner = torch.tensor([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [0.5, 0.0], [0.5, 0.5]])
    bary[::3] = corner[torch.arange(len(bary[::3])) % 5]
    face = torch.arange(size * size, dtype=torch.int32)
    texels = Texels(face.view(size, size).to(device), bary.view(size, size, 2).to(device), (face >= 0).view(size, size))
    values = bake(mesh, size, lambda *at: torch.cat(at, 1), texels=texels, tangents=True)["value"]
    position, normal, along = values.view(-1, 10).split([3, 3, 4], 1)
    assert finite(position, normal, along)
    ones = torch.ones(size * size)
    torch.testing.assert_close(normal.norm(dim=1).cpu(), ones, rtol=0, atol=1e-6)
    torch.testing.assert_close(along[:, :3].norm(dim=1).cpu(), ones, rtol=0, atol=1e-6)
    w = torch.cat([1 - bary.double().sum(1, keepdim=True), bary.double()], 1)[..., None]
    expected = (corners[: size * size].double() * w).sum(1)
    reach = corners[: size * size].abs().amax((1, 2))[:, None]
    assert bool(((position.cpu() - expected).abs() <= 3e-7 * reach).all())  # a float32 sum of three terms
    total = (opposite[: size * size].double() * w).sum(1)
    clear = total.norm(dim=1) > 0.01
    torch.testing.assert_close(normal.cpu().double()[clear], normalize(total[clear], dim=1), rtol=0, atol=2e-5)


def test_distance_to_the_hull_of_points_anywhere(device):
    """Finite for every point, and the documented value where a point is nowhere or not before a camera."""
    g = torch.Generator().manual_seed(23)
    distance = torch.randn(3, 16, 24, generator=g) * 10
    c2w = torch.eye(4).repeat(3, 1, 1)
    c2w[:, :3, 3] = torch.tensor([[0.0, 0.0, 2.0], [0.5, 0.0, 2.0], [0.0, 0.5, 3.0]])
    k = torch.tensor([30.0, 28.0, 12.0, 8.0]).repeat(3, 1)
    points = torch.randn(N, 3, generator=g) * 10.0 ** torch.randint(-6, 3, (N, 1), generator=g)
    kind = torch.randint(10, (N,), generator=g)
    points = torch.where((kind == 0)[:, None], c2w[torch.arange(N) % 3, :3, 3], points)  # at a camera
    points[kind == 1, 2] = c2w[1, 2, 3]  # in the plane of one
    points[kind == 2] = wild((int((kind == 2).sum()), 3), g).clamp(-1e30, 1e30)  # the distance itself must fit
    points[kind == 3, 1], points[kind == 4, 0] = math.nan, math.inf
    got = hull_distance(points.to(device), distance.to(device), Camera(c2w, k, 24, 16).to(device)).cpu()
    assert finite(got)
    away = points[:, None].double() - c2w[:, :3, 3].double()
    depth = -away[..., 2]
    assert bool((got[(depth <= 0).any(1)] == -1000).all())
    assert bool((got[~torch.isfinite(points).all(1)] == -1000).all())
    pixel = torch.stack([k[0, 2] + k[0, 0] * away[..., 0] / depth, k[0, 3] - k[0, 1] * away[..., 1] / depth], -1)
    ndc = (pixel / torch.tensor([24.0, 16.0]) * 2 - 1).clamp(-9, 9)  # (N, V, 2); clamped at the border either way
    seen = torch.nn.functional.grid_sample(
        distance.double()[:, None],
        ndc.transpose(0, 1)[:, None],
        mode="bilinear",
        padding_mode="border",
        align_corners=False,
    )[:, 0, 0].T
    expected = (seen * depth * 2 / (k[0, 0] + k[0, 1])).amin(1)
    plain = (depth > 1e-3).all(1) & (points.abs() < 1e6).all(1)
    assert plain.sum() > N // 3
    # a pixel coordinate errs by 1e-7 of itself, and the map changes by 60 from pixel to pixel
    error = (got.double() - expected).abs() / (depth.amax(1) * (1 + pixel.abs().amax((1, 2)).clamp(max=1e3)))
    assert float(error[plain].max()) < 1e-5
