"""A known color baked on real meshes and extracted surfaces, written as GLB and read back as a viewer samples it."""

import io

import numpy as np
import pytest
import torch
from PIL import Image

from bench.surface import field
from reli3d.geometry.bake import bake
from reli3d.geometry.mesh import Mesh
from reli3d.geometry.surface import extract_surface
from reli3d.geometry.tangents import encode_normals
from reli3d.geometry.uv import unwrap
from reli3d.io.glb import encode_image, write_glb
from reli3d.render.asset import Asset, TextureSet
from reli3d.render.color import srgb_to_linear
from tests.support import gltf
from tests.support.meshes import QUICK, SLOW, loaded
from tests.support.texels import bilinear, color

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
