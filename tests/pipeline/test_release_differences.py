"""Where the published release is wrong and this package is not, each with the size of the difference.

The release's results are its own values where there are some, else those of its formula.  Other such differences
are shown where their part is tested; docs/model.md lists them all.
"""

import io
import math

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image
from torch.nn.functional import grid_sample, normalize

from reli3d.geometry.bake import bake, rasterize_texels
from reli3d.geometry.mesh import Mesh
from reli3d.geometry.surface import extract_surface
from reli3d.geometry.tangents import encode_normals
from reli3d.geometry.triplane import sample_triplane
from reli3d.geometry.uv import unwrap
from reli3d.io.glb import read_glb, write_glb
from reli3d.render.asset import Asset, TextureSet
from reli3d.render.environment import Environment
from reli3d.render.latlong import lat_long_directions, quarter_turn
from tests.support.meshes import mesh_from, volume
from tests.support.reference import decode_normals

SIZE = 128


@pytest.fixture(scope="module")
def ball() -> Mesh:
    return unwrap(mesh_from(trimesh.creation.icosphere(2)).with_normals(), texture_size=SIZE).with_tangents()


def degrees(a, b):
    cosine = (normalize(a.double(), dim=-1) * normalize(b.double(), dim=-1)).sum(-1)
    return torch.rad2deg(cosine.clamp(-1, 1).acos())


def test_texels_are_baked_at_their_centers(goldens):
    """The release's own bake is ours of a chart half a texel further right and down."""
    bar, unwrapped = np.load(goldens / "texture_bake_96.npz"), np.load(goldens / "uv_unwrap.npz")
    corners = torch.from_numpy(unwrapped["v"])[torch.from_numpy(unwrapped["f"]).long()].reshape(-1, 3)
    uv = torch.from_numpy(unwrapped["exploded_uv"]) * torch.tensor([1.0, -1.0]) + torch.tensor([0.0, 1.0])
    faces = torch.arange(len(corners), dtype=torch.int32).reshape(-1, 3)

    def offset(shift: float) -> np.ndarray:
        mesh = Mesh(corners, faces, uv=uv + shift / 96)
        texels = rasterize_texels(mesh, 96)
        baked = bake(mesh, 96, lambda p, n: p, texels=texels)["value"].numpy()
        both = bar["mask"] & texels.inside.numpy() & (bar["rast"][..., 3].astype(int) == texels.face.numpy())
        assert both.sum() > 1000
        return np.abs(baked - bar["position_bake"])[both].max(-1)

    assert offset(0.5).max() < 1e-5  # the same points: corners of texels
    assert np.median(offset(0.0)) > 1e-3  # centers lie elsewhere


def test_normal_maps_are_relative_to_the_normals_they_are_shown_with(ball):
    """The release encodes in flat frames and exports smooth normals: a smooth surface becomes faceted."""
    texels = rasterize_texels(ball, SIZE)
    flat = ball.vertices[ball.faces.long()]
    flat = normalize(torch.linalg.cross(flat[:, 1] - flat[:, 0], flat[:, 2] - flat[:, 0]), dim=-1)
    index = texels.inside.reshape(-1).nonzero()[:, 0]
    faces = flat[texels.face.reshape(-1)[index].long()]
    kept = {}

    def fn(position, normal, tangent):
        kept.update(p=position, n=normal, t=tangent)
        return normal

    bake(ball, SIZE, fn, texels=texels, tangents=True, chunk=1 << 20)
    inside = texels.inside.reshape(-1)[texels.valid.reshape(-1)]
    expected, n, t = kept["p"][inside], kept["n"][inside], kept["t"][inside]  # the normal of a sphere is its position
    release = decode_normals(encode_normals(expected, faces, t), n, t)
    ours = decode_normals(encode_normals(expected, n, t), n, t)
    assert degrees(ours, expected).max() < 0.1  # float32 near cos = 1
    assert degrees(release, expected).quantile(0.9) > 5  # faces of this ball lean up to 10 degrees


def test_normal_and_material_maps_are_stored_without_loss(ball, tmp_path):
    generator = torch.Generator().manual_seed(0)
    tilt = torch.nn.functional.interpolate(torch.randn(1, 2, 16, 16, generator=generator) * 0.3, (SIZE, SIZE))[0]
    normal = normalize(torch.stack([tilt[0], tilt[1], torch.ones(SIZE, SIZE)], -1), dim=-1) * 0.5 + 0.5
    plain = torch.full((SIZE, SIZE, 3), 0.5)
    write_glb(tmp_path / "ball.glb", Asset(ball, TextureSet(plain, normal[..., 1], normal[..., 2], normal)))
    back = read_glb(tmp_path / "ball.glb")[0].textures
    steps = (normal * 255).round() / 255
    torch.testing.assert_close(back.normal, steps, rtol=0, atol=1e-6)
    torch.testing.assert_close(torch.stack([back.roughness, back.metallic], -1), steps[..., 1:], rtol=0, atol=1e-6)
    buffer = io.BytesIO()
    Image.fromarray((normal * 255).round().byte().numpy()).save(buffer, "JPEG", quality=75)  # as the release
    jpeg = torch.from_numpy(np.asarray(Image.open(buffer)).astype(np.float32) / 255)
    assert degrees(back.normal * 2 - 1, normal * 2 - 1).max() < 0.5
    assert degrees(jpeg * 2 - 1, normal * 2 - 1).quantile(0.99) > 3


@pytest.mark.parametrize("name", ["allpos", "allneg"])
def test_an_empty_field_has_no_faces_and_a_full_one_is_an_outward_box(goldens, name):
    data = np.load(goldens / "flexicubes_16.npz")
    assert len(data[f"{name}.f"]) > 0  # the release makes a box of it
    sdf = torch.from_numpy(data[f"{name}.level"]).view(17, 17, 17)
    release = Mesh(torch.from_numpy(data[f"{name}.v"]), torch.from_numpy(data[f"{name}.f"]).int())
    assert volume(release) < 0.0  # inward
    ours = extract_surface(sdf, radius=0.5)
    assert len(ours.faces) == 0 if name == "allpos" else volume(ours) > 0.95  # of a box of volume 1


def release_lookup(radiance: torch.Tensor, directions: torch.Tensor) -> torch.Tensor:
    theta = torch.atan2(directions[:, 0], directions[:, 2]) % (2 * math.pi)
    at = torch.stack([1 - theta / (2 * math.pi), directions[:, 1].clamp(-1, 1).acos() / math.pi], -1) * 2 - 1
    return grid_sample(
        radiance.permute(2, 0, 1)[None], at[None, None], mode="bilinear", padding_mode="border", align_corners=True
    )[0, :, 0].T


def test_environment_lookups_meet_texel_centers_and_wrap(goldens):
    data = np.load(goldens / "env_parametrisation.npz")
    radiance = torch.from_numpy(np.load(goldens / "reni_decoder.npz")["env_map"][1])
    stored = torch.from_numpy(data["sampled"])
    computed = release_lookup(radiance, torch.from_numpy(data["direction"]))
    torch.testing.assert_close(computed, stored, rtol=1e-4, atol=1e-5)  # the release's mapping
    ours = quarter_turn(radiance, -1)
    environment, centers = Environment(ours), lat_long_directions(64).reshape(-1, 3).contiguous()
    texels = ours.reshape(-1, 3)
    scale = float(texels.std())
    assert (environment.lookup(centers) - texels).abs().max() < 1e-3 * scale  # 1e-7 of u times 128 texels
    assert (release_lookup(radiance, centers) - texels).abs().mean() > 1e-2 * scale
    seam = torch.tensor([[1e-5, 0.2, 1.0], [-1e-5, 0.2, 1.0]])  # both sides of +Z
    seam = normalize(seam, dim=-1)
    ramp = torch.arange(128.0).cos()[None, :, None].expand(64, 128, 3).contiguous()
    ours, theirs = Environment(quarter_turn(ramp, -1)).lookup(seam), release_lookup(ramp, seam)
    assert (ours[0] - ours[1]).abs().max() < 1e-3 and (theirs[0] - theirs[1]).abs().max() > 0.5


def test_light_samples_point_at_the_light():
    """The release samples z-up polar coordinates of a map that it reads y-up."""
    radiance = torch.full((32, 64, 3), 0.01)
    radiance[6, 45] = 1000.0
    environment = Environment(radiance)
    d, _ = environment.sample(torch.rand(2000, 2, generator=torch.Generator().manual_seed(0)))
    light = lat_long_directions(32)[6, 45]
    assert (degrees(d, light.expand_as(d)) < 12).float().mean() > 0.9  # two texels: a lookup mixes neighbors
    # the center of the bright texel, whose column is 45 + 16 in the published mapping
    theta, phi = math.pi * 6.5 / 32, 2 * math.pi * 61.5 / 64
    release = torch.tensor([[math.sin(theta) * math.cos(phi), math.sin(theta) * math.sin(phi), math.cos(theta)]])
    assert degrees(release, light[None]) > 60 and float(environment.lookup(release).max()) < 0.02


def test_points_of_a_half_precision_triplane_keep_their_place():
    """The release casts coordinates to the planes' type; near the border a step of float16 is a tenth of a texel."""
    size = 384
    ramp = torch.arange(float(size)).expand(1, 3, 1, size, size).contiguous().half()  # whole numbers: exact in half
    x = torch.linspace(0.9, 0.99, 2001)
    points = torch.stack([x, torch.zeros_like(x), torch.zeros_like(x)], -1)[None]
    exact = (x.double() + 1) * size / 2 - 0.5
    ours = sample_triplane(ramp, points)[0, :, 0].double()
    release = sample_triplane(ramp, points.half().float())[0, :, 0].double()
    assert (ours - exact).abs().max() < 1e-3  # float32 of 384
    assert (release - exact).abs().max() > 0.04
