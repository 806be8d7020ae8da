"""Texels against brute force in float64, baking against closed forms, tangents against an exporter, files read back."""

import io
import math

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image
from scipy import ndimage

from bench.surface import field
from reli3d.geometry.bake import bake, nearest_valid, rasterize_texels
from reli3d.geometry.mesh import Mesh
from reli3d.geometry.surface import extract_surface
from reli3d.geometry.tangents import encode_normals
from reli3d.geometry.uv import unwrap
from reli3d.io.glb import encode_image, write_glb
from reli3d.render.asset import Asset, TextureSet
from reli3d.render.color import srgb_to_linear
from tests.support import gltf
from tests.support.meshes import QUICK, SLOW, loaded, mesh_from
from tests.support.reference import decode_normals

SIZE = 256


def color(p):
    """Smooth colors in [0.1, 0.9] of positions; their second derivative is at most 3.6."""
    return 0.5 + 0.4 * torch.sin(3.0 * p + torch.tensor([0.0, 1.0, 2.0], device=p.device, dtype=p.dtype))


def bilinear(image: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """Lookup ``(N, C)`` as glTF defines it, float64, clamped to the edge."""
    at = (uv.astype(np.float64) * len(image) - 0.5).T[::-1]
    channels = np.moveaxis(image.reshape(*image.shape[:2], -1).astype(np.float64), -1, 0)
    return np.stack([ndimage.map_coordinates(channel, at, order=1, mode="nearest") for channel in channels], -1)


def icosphere(subdivisions: int, device="cpu") -> Mesh:
    return mesh_from(trimesh.creation.icosphere(subdivisions), device).with_normals()


@pytest.fixture(scope="module")
def sphere() -> Mesh:
    return unwrap(icosphere(4), texture_size=SIZE).with_tangents()


def surface_samples(mesh: Mesh, n: int, seed: int = 0):
    """Random faces and weights: positions and UV, float64."""
    rng = np.random.default_rng(seed)
    w = rng.dirichlet((1, 1, 1), n)[:, :, None]
    face = mesh.faces.cpu().numpy()[rng.integers(0, len(mesh.faces), n)]
    return (mesh.vertices.cpu().numpy().astype(np.float64)[face] * w).sum(1), (mesh.uv.cpu().numpy()[face] * w).sum(1)


def test_texels_match_brute_force(device):
    rng = torch.Generator().manual_seed(3)
    uv = torch.rand(30, 2, generator=rng)
    faces = torch.arange(30).reshape(-1, 3).int()
    mesh = Mesh(torch.rand(30, 3, generator=rng), faces, uv=uv).to(device)  # ten triangles that overlap as they like
    size = 40
    got = rasterize_texels(mesh, size)
    q = uv.double().numpy()[faces.numpy()] * size
    y, x = np.mgrid[:size, :size] + 0.5
    p = np.stack([x, y], -1).reshape(-1, 1, 2)
    a, b, c = q[:, 0], q[:, 1], q[:, 2]

    def cross(u, v):
        return u[..., 0] * v[..., 1] - u[..., 1] * v[..., 0]

    w = np.stack([cross(p - a, c - a), cross(b - a, p - a)], -1) / cross(b - a, c - a)[:, None]
    inside = (w.min(-1) >= 0) & (w.sum(-1) <= 1)
    # not within float32 of an edge
    clear = np.abs(np.concatenate([w, 1 - w.sum(-1, keepdims=True)], -1)).min(-1) > 1e-5
    first = np.where(inside.any(1), inside.argmax(1), -1)
    same = clear.all(1)
    got_first = torch.where(got.inside, got.face, -1).cpu().numpy().ravel()
    assert np.array_equal(got_first[same], first[same]) and same.mean() > 0.95
    covered, bary = same & (first >= 0), got.bary.cpu().numpy().reshape(-1, 2)
    # weights are cross products over an area; the smallest triangle here has 20 texels, float32 keeps 5 digits of it
    np.testing.assert_allclose(bary[covered], w[np.arange(len(w)), first][covered], atol=2e-4)
    # border texels: nearest point of all edges
    ends = np.stack([q, np.roll(q, -1, 1)], 2).reshape(-1, 2, 2)
    e = ends[:, 1] - ends[:, 0]
    t = np.clip(((p - ends[:, 0]) * e).sum(-1) / (e * e).sum(-1), 0, 1)
    distance = np.linalg.norm(ends[:, 0] + t[..., None] * e - p, axis=-1).min(1)
    outside = ~inside.any(1) & same
    valid = got.valid.cpu().numpy().ravel()
    settled = outside & (np.abs(distance - 1.5) > 1e-4)
    assert np.array_equal(valid[settled], distance[settled] < 1.5)
    ring = outside & valid
    full = np.concatenate([1 - bary.sum(1, keepdims=True), bary], 1)
    point = (q[got.face.cpu().numpy().ravel()[ring]] * full[ring][:, :, None]).sum(1)
    np.testing.assert_allclose(np.linalg.norm(point - p[ring][:, 0], axis=1), distance[ring], atol=1e-4)


def test_bilinear_lookup_reads_the_surface_only(sphere):
    texels = rasterize_texels(sphere, SIZE)
    _, uv = surface_samples(sphere, 100_000)
    assert bilinear(texels.valid.numpy().astype(float)[..., None], uv).min() == pytest.approx(1.0, abs=1e-12)


def test_known_color_reads_back(sphere):
    image = bake(sphere, SIZE, lambda p, n: color(p))["value"].numpy()
    position, uv = surface_samples(sphere, 50_000)
    expected = color(torch.from_numpy(position)).numpy()
    error = np.abs(bilinear(image, uv) - expected)
    # a texel is 0.022 long here: bilinear errs by 3.6 * h^2 / 8 = 2e-4 inside, border texels hold a point up to h away
    assert error.mean() < 0.2 / 255
    assert error.max() < 1.2 * 1.5 * 0.022 * 1.8


def test_known_color_reads_back_through_the_file_at_every_mip(sphere, tmp_path):
    def material(p, n, t):
        one = torch.ones_like(p[:, :1])
        return {
            "base_color": srgb_to_linear(color(p)),
            "roughness": one,
            "metallic": one,
            "normal": encode_normals(n, n, t),
        }

    write_glb(tmp_path / "ball.glb", Asset(sphere, TextureSet(**bake(sphere, SIZE, material, tangents=True))))
    read = trimesh.load(tmp_path / "ball.glb", force="mesh", process=False)
    image = np.asarray(read.visual.material.baseColorTexture.convert("RGB")) / 255.0
    rng = np.random.default_rng(2)
    w, face = rng.dirichlet((1, 1, 1), 50_000)[:, :, None], read.faces[rng.integers(0, len(read.faces), 50_000)]
    uv = (read.visual.uv[face] * w).sum(1) * [1, -1] + [0, 1]  # trimesh turns v up
    expected = color(torch.from_numpy((np.asarray(read.vertices)[face] * w).sum(1))).numpy()
    # 8 bit: a quarter of a step on average; the bake itself stays under a fifth (see above)
    assert np.abs(bilinear(image, uv) - expected).mean() < 0.5 / 255
    while image.shape[0] >= 64:  # colors are at least 0.1: whatever is darker was never written
        assert image.min() > 0.1 - 0.6 / 255
        image = 0.25 * (image[::2, ::2] + image[1::2, ::2] + image[::2, 1::2] + image[1::2, 1::2])


def test_constant_survives_every_mip_down_to_64(sphere):
    image = bake(sphere, SIZE, lambda p, n: torch.full_like(p, 0.25))["value"].permute(2, 0, 1)[None]
    while image.shape[-1] >= 64:
        assert float(image.min()) == float(image.max()) == 0.25  # no texel was left black, so no mean mixes one in
        image = torch.nn.functional.avg_pool2d(image, 2)


def test_chunks_and_reused_texels_do_not_matter(sphere):
    texels = rasterize_texels(sphere, SIZE)
    one = bake(sphere, SIZE, lambda p, n: {"a": color(p), "b": n[:, :1]})
    other = bake(sphere, SIZE, lambda p, n: {"a": color(p), "b": n[:, :1]}, chunk=777, texels=texels)
    assert all(torch.equal(one[k], other[k]) for k in "ab") and one["b"].shape == (SIZE, SIZE, 1)
    bare = bake(sphere, SIZE, lambda p, n: color(p), texels=texels, fill=False)["value"]
    nearest = nearest_valid(texels.valid)[0].reshape(-1).long()
    assert torch.equal(bare.reshape(-1, 3)[nearest], one["a"].reshape(-1, 3))
    assert float(bare[~texels.valid].abs().max()) == 0.0


def test_numbers_of_the_vertices_reach_the_texels(sphere):
    """The vertices' own coordinates, interpolated, are the texels' positions; in any chunks."""
    numbers = torch.cat([sphere.vertices, 2.0 * sphere.vertices[:, :1]], -1)
    for chunk in (1 << 18, 777):
        both = bake(sphere, SIZE, lambda p, n, v: torch.cat([p, v], -1), values=numbers, chunk=chunk)["value"]
        torch.testing.assert_close(both[..., 3:6], both[..., :3], rtol=0, atol=1e-6)  # float32 of numbers below 1
        torch.testing.assert_close(both[..., 6], 2.0 * both[..., 0], rtol=0, atol=2e-6)
    with pytest.raises(ValueError, match="values: expected"):
        bake(sphere, SIZE, lambda p, n, v: v, values=numbers[1:])


@pytest.mark.parametrize("shape, fraction", [((64, 64), 0.02), ((33, 130), 0.3), ((1, 50), 0.1), ((50, 1), 0.1)])
def test_nearest_valid_is_exact(device, shape, fraction):
    valid = torch.rand(shape, generator=torch.Generator().manual_seed(5)) < fraction
    valid[0, 0] = True
    source, square = (t.cpu() for t in nearest_valid(valid.to(device)))
    assert np.array_equal(np.rint(ndimage.distance_transform_edt(~valid.numpy()) ** 2), square.numpy())
    y, x = torch.meshgrid(torch.arange(shape[0]), torch.arange(shape[1]), indexing="ij")
    assert bool(valid.reshape(-1)[source.long()].all())
    assert torch.equal(((source // shape[1] - y) ** 2 + (source % shape[1] - x) ** 2).float(), square)


def test_without_a_valid_texel_there_is_no_nearest_one(device):
    source, square = nearest_valid(torch.zeros(9, 9, dtype=torch.bool, device=device))
    assert bool((source == -1).all()) and bool((square == math.inf).all())


def test_faults_are_named(sphere):
    with pytest.raises(ValueError, match="mesh.uv: expected UV"):
        rasterize_texels(icosphere(0), 16)
    with pytest.raises(ValueError, match="mesh.uv: expected finite"):
        rasterize_texels(Mesh(sphere.vertices, sphere.faces, uv=sphere.uv * float("nan")), 16)
    with pytest.raises(ValueError, match="covers no texel"):
        bake(Mesh(sphere.vertices, sphere.faces, uv=sphere.uv + 3.0), 16, lambda p, n: p)
    with pytest.raises(ValueError, match=r"fn\(\)\['value'\]: expected shape"):
        bake(sphere, 16, lambda p, n: p[:1])
    with pytest.raises(TypeError, match=r"fn\(\): expected dict, got NoneType"):
        bake(sphere, 16, lambda p, n: None)
    names = iter(("base", "base", "other"))
    with pytest.raises(ValueError, match=r"fn\(\): expected base as before, got other"):
        bake(sphere, 16, lambda p, n: {next(names): p}, chunk=64)
    with pytest.raises(ValueError, match="chunk"):
        bake(sphere, 16, lambda p, n: p, chunk=0)
    with pytest.raises(ValueError, match="mesh.normals"):
        Mesh(sphere.vertices, sphere.faces, uv=sphere.uv).with_tangents()


def test_tangents_of_a_cylinder_follow_u(device):
    k = 64
    angle = torch.arange(k + 1) * (2 * math.pi / k)
    ring = torch.stack([angle.cos(), torch.zeros(k + 1), -angle.sin()], 1)
    normals = ring.repeat(2, 1)
    vertices = torch.cat([ring, ring + torch.tensor([0.0, 2, 0])])
    i = torch.arange(k)
    faces = torch.cat([torch.stack([i, i + 1, k + 2 + i], 1), torch.stack([i, k + 2 + i, k + 1 + i], 1)]).int()
    uv = torch.stack([angle.repeat(2) / (2 * math.pi), torch.cat([torch.ones(k + 1), torch.zeros(k + 1)])], 1)
    mesh = Mesh(vertices, faces, normals, uv).to(device)
    expected = torch.stack([-angle.sin(), torch.zeros(k + 1), -angle.cos()], 1).repeat(2, 1)
    for flip, w in ((1.0, 1.0), (-1.0, -1.0)):
        turned = mesh.uv * mesh.uv.new_tensor([flip, 1.0])
        t = Mesh(mesh.vertices, mesh.faces, mesh.normals, turned).with_tangents().tangents.cpu()
        assert torch.equal(t[:, 3], torch.full((2 * k + 2,), w))
        cosine = (t[:, :3] * expected).sum(1) * flip
        inner = torch.arange(2 * k + 2) % (k + 1) % k > 0
        # float32; the rim sees one side only: half a facet, projected flat
        assert float(cosine[inner].min()) > 1 - 1e-6
        assert float(cosine.min()) > math.cos(math.pi / k) - 1e-6


def test_tangents_weigh_faces_by_their_angle(device):
    """At the origin a face of 90 degrees has +u along (1, 0), one of 45 degrees along (1, 1), solved analytically."""
    p = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [-1, 1, 0]], device=device)
    uv = torch.tensor([[0.0, 0], [1, 0], [0, -1], [-1, -2]], device=device)
    faces = torch.tensor([[0, 1, 2], [0, 2, 3]], device=device).int()
    got = Mesh(p, faces, torch.tensor([0.0, 0, 1], device=device).repeat(4, 1), uv).with_tangents().tangents[0].cpu()
    expected = math.pi / 2 * torch.tensor([1.0, 0, 0]) + math.pi / 4 * torch.tensor([0.5, 0.5, 0]) * 2**0.5
    torch.testing.assert_close(got, torch.cat([expected / expected.norm(), torch.ones(1)]), rtol=0, atol=1e-6)


def test_tangents_agree_with_an_exporter(shared_data):
    """NormalTangentMirrorTest stores MikkTSpace tangents, with mirrored UV."""
    document, binary = gltf.parsed((shared_data / "calibration" / "calib_normal_tangent_mirror.glb").read_bytes())
    primitive = document["meshes"][0]["primitives"][0]
    places = [
        *(primitive["attributes"][k] for k in ("POSITION", "NORMAL", "TANGENT", "TEXCOORD_0")),
        primitive["indices"],
    ]
    p, n, t, uv, faces = (gltf.array_of(document, binary, place) for place in places)
    faces = faces.reshape(-1, 3).astype(np.int32)
    got = Mesh(*(torch.from_numpy(v.copy()) for v in (p, faces, n, uv))).with_tangents().tangents.numpy()
    assert (np.sign(got[:, 3]) == np.sign(t[:, 3])).mean() > 0.999 and (t[:, 3] < 0).any() and (t[:, 3] > 0).any()
    cosine = (got[:, :3] * t[:, :3]).sum(1)
    assert np.median(cosine) > 0.99999 and (cosine > 0.999).mean() > 0.98  # vertices were welded after its export


def test_normal_map_decodes_to_the_world_normal_within_a_degree(sphere):
    def world(p, n):
        return torch.nn.functional.normalize(n + 0.3 * torch.sin(5.0 * p + 1.0), dim=1)

    kept = {}

    def fn(p, n, t):
        kept.setdefault("parts", []).append((world(p, n), n, t))
        return encode_normals(world(p, n), n, t)

    texels = rasterize_texels(sphere, SIZE)
    image = bake(sphere, SIZE, fn, texels=texels, tangents=True)["value"]
    expected, n, t = (torch.cat(v) for v in zip(*kept["parts"]))
    assert bool((t[:, 3] == 1).all())  # no chart is mirrored
    stored = (image.reshape(-1, 3)[texels.valid.reshape(-1)] * 255).round() / 255
    # the shader of glTF 2.0, section 3.9.3, in float64: bitangent from the exported w, green up
    s = stored.double() * 2 - 1
    b = torch.linalg.cross(n.double(), t[:, :3].double()) * t[:, 3:].double()
    shaded = torch.nn.functional.normalize(s[:, :1] * t[:, :3] + s[:, 1:2] * b + s[:, 2:] * n, dim=1)
    angle = torch.rad2deg(torch.acos((shaded * expected.double()).sum(1).clamp(-1, 1)))
    # 8 bit: half a step of 2 / 255 in each of three channels is at most 0.39 degrees
    assert float(angle.max()) < 0.45
    torch.testing.assert_close(decode_normals(stored, n, t).double(), shaded, rtol=0, atol=1e-5)


def test_encoding_bends_normals_up_and_gives_exact_ones_back():
    n = torch.tensor([[0.0, 0, 1]] * 3)
    t = torch.tensor([[1.0, 0, 0, 1], [1, 0, 0, -1], [1, 0, 0, 1]])
    world = torch.tensor([[0.6, 0, 0.8], [0, 0.6, 0.8], [0.6, 0.0, -0.8]])
    # w = -1 turns green; below: on the horizon
    expected = torch.tensor([[0.8, 0.5, 0.9], [0.5, 0.2, 0.9], [1.0, 0.5, 0.5]])
    torch.testing.assert_close(encode_normals(world, n, t), expected)


def test_decoding_and_its_gradient_are_the_inverse_of_encoding(device):
    """Together the two only normalize: the gradient is the part of a weight that is orthogonal to the normal."""
    g = torch.Generator().manual_seed(2)
    world, n, t, weight = (
        torch.nn.functional.normalize(torch.randn(30, 40, 3, generator=g), dim=-1).to(device) for _ in range(4)
    )
    t = torch.nn.functional.normalize(t - 0.9 * (t * n).sum(-1, keepdim=True) * n, dim=-1)  # not quite orthogonal
    t = torch.cat([t, torch.where(torch.rand(30, 40, 1, generator=g) < 0.5, -1.0, 1.0).to(device)], -1)
    leaf = world.clone().requires_grad_()
    got = encode_normals(leaf, n, t)
    above = got.detach()[..., 2] > 0.5 + 0.02  # not bent up; where the frame has little area rounding is magnified
    decoded = decode_normals(got, n, t)
    torch.testing.assert_close(decoded[above].detach(), world[above], rtol=0, atol=1e-4)
    (gradient,) = torch.autograd.grad((decoded[above] * weight[above]).sum(), leaf)
    across = weight - (weight * world).sum(-1, keepdim=True) * world
    torch.testing.assert_close(gradient[above], across[above], rtol=0, atol=2e-3)  # 1e-4, over a cosine of 0.04
    assert not bool(gradient[~above].any())


STEP = 1 / 255
DARKEST = 0.1  # of the color's values: a darker texel was never written


def unit_size(mesh: Mesh) -> Mesh:
    low, high = mesh.vertices.min(0).values, mesh.vertices.max(0).values
    return Mesh((mesh.vertices - (low + high) / 2) / ((high - low).max() / 2), mesh.faces)


def baked(mesh: Mesh, size: int) -> Asset:
    mesh = unwrap(mesh, texture_size=size).with_tangents()

    def material(p, n, t):
        rough, metal = ((0.5 + 0.4 * p[:, k : k + 1]).clamp(0, 1) for k in (1, 2))
        return {
            "base_color": srgb_to_linear(color(p)),
            "roughness": rough,
            "metallic": metal,
            "normal": encode_normals(n, n, t),
        }

    return Asset(mesh, TextureSet(**bake(mesh, size, material, tangents=True)))


def read(path) -> tuple[dict[str, np.ndarray], list[np.ndarray]]:
    """Attributes and images of a file of one primitive, by the standard alone."""
    document, binary = gltf.parsed(path.read_bytes())
    (primitive,) = document["meshes"][0]["primitives"]
    arrays = {name: gltf.array_of(document, binary, index) for name, index in primitive["attributes"].items()}
    arrays["faces"] = gltf.array_of(document, binary, primitive["indices"]).reshape(-1, 3).astype(np.int64)
    views = (gltf.view_of(document, binary, image["bufferView"]) for image in document["images"])
    images = [Image.open(io.BytesIO(view)) for view in views]
    assert all(image.format == "PNG" and image.mode == "RGB" for image in images)
    return arrays, [np.asarray(image) / 255.0 for image in images]


def check_file(path, source: Mesh) -> float:
    """Mean error of the base color over the surface; everything else is asserted."""
    arrays, (image, orm, normal_map) = read(path)
    p, n, t, uv = (arrays[k].astype(np.float64) for k in ("POSITION", "NORMAL", "TANGENT", "TEXCOORD_0"))
    faces = arrays["faces"]
    assert len(faces) == len(source.faces) and faces.max() < len(p)
    assert np.abs(np.linalg.norm(n, axis=1) - 1).max() < 1e-3
    assert np.abs(np.linalg.norm(t[:, :3], axis=1) - 1).max() < 1e-3
    assert np.abs((t[:, :3] * n).sum(1)).max() < 1e-3 and set(np.unique(t[:, 3])) <= {-1.0, 1.0}
    assert np.isfinite(uv).all() and uv.min() >= 0 and uv.max() <= 1
    # points of the surface, uniform in area
    rng, count = np.random.default_rng(0), 50_000
    area = np.linalg.norm(np.cross(p[faces[:, 1]] - p[faces[:, 0]], p[faces[:, 2]] - p[faces[:, 0]]), axis=1)
    corner = faces[rng.choice(len(faces), count, p=area / area.sum())]
    w = rng.dirichlet((1, 1, 1), count)[:, :, None]
    position, at = (p[corner] * w).sum(1), (uv[corner] * w).sum(1)
    # roughness is green, metallic blue: 8 bit and a bilinear lookup of linear ramps, clipped at charts' borders
    ramps = np.clip(0.5 + 0.4 * position[:, 1:], 0, 1)
    assert np.abs(bilinear(orm, at)[:, 1:] - ramps).mean() < STEP
    flat = bilinear(normal_map, at) * 2 - 1  # the baked normal is the mesh's own: +Z of its frame
    assert np.median(flat[:, 2]) > 0.9999 and np.abs(flat[:, :2]).mean() < 1.5 * STEP
    expected, half = color(torch.from_numpy(position)).numpy(), 0.5 / len(image)
    shifts = np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]]) * half
    error = [np.abs(bilinear(image, at + shift) - expected).mean() for shift in shifts]
    assert min(error[1:]) > error[0]  # half a texel to any side fits worse
    level = image
    while len(level) >= 64:  # no texel at all is black, at any mip level, so no lookup can reach one
        assert level.min() > DARKEST - 0.6 * STEP
        level = 0.25 * (level[::2, ::2] + level[1::2, ::2] + level[::2, 1::2] + level[1::2, 1::2])
    return float(error[0])


@pytest.mark.parametrize("name", QUICK + [pytest.param(n, marks=pytest.mark.slow) for n in SLOW])
def test_known_color_reads_back_from_the_file_of_a_real_mesh(shared_data, tmp_path, name):
    mesh = unit_size(loaded(shared_data / "meshes" / f"{name}.glb"))
    write_glb(tmp_path / "a.glb", baked(mesh, 1024))
    error = check_file(tmp_path / "a.glb", mesh)
    assert error < STEP, f"{error / STEP:.3f} of a step"


@pytest.mark.parametrize("n", [24, pytest.param(80, marks=pytest.mark.slow), pytest.param(160, marks=pytest.mark.slow)])
def test_known_color_reads_back_from_the_file_of_an_extracted_surface(tmp_path, n):
    mesh = extract_surface(field(n, "cpu"), radius=0.87)
    size = 1024 if n > 24 else 512
    write_glb(tmp_path / "a.glb", baked(mesh, size))
    assert check_file(tmp_path / "a.glb", mesh) < 0.5 * STEP  # smooth charts: 8 bit alone is a quarter of a step


@pytest.mark.parametrize("shape", [(1, 1), (1, 7), (5, 1), (33, 64)])
def test_png_is_exact(shape):
    pixels = torch.randint(0, 256, (*shape, 3), generator=torch.Generator().manual_seed(1))
    stored = np.asarray(Image.open(io.BytesIO(encode_image(pixels / 255.0))))
    assert np.array_equal(stored, pixels.numpy())
