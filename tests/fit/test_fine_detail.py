"""Detail of photographs in the base color: a textured square, photographed in closed form under smooth shading."""

from dataclasses import replace

import pytest
import torch

import reli3d
from reli3d import pipeline
from reli3d.fit import refine as fit
from reli3d.fit.choice import Parts
from reli3d.fit.fine_detail import Crop, log_ratio, with_fine_detail
from reli3d.geometry.camera import Camera, camera_rays, look_at
from reli3d.geometry.mesh import Mesh
from reli3d.geometry.rays import RayScene
from reli3d.render.asset import Asset, TextureSet
from reli3d.render.color import linear_to_srgb
from reli3d.render.environment import Environment

TEXELS, PIXELS, COARSE = 256, 256, 96
EYES = ((0.0, 0.0, 3.0), (0.8, 0.3, 2.8), (-0.7, 0.5, 2.8), (0.3, -0.9, 2.8))


def pattern(position: torch.Tensor) -> torch.Tensor:
    """Base color ``(..., 3)`` at points of the square: stripes of 11 texels, finer than the fit's images show."""
    x, y = position[..., 0], position[..., 1]
    wave = torch.sin(75.0 * x) * torch.sin(75.0 * y)
    return torch.stack([0.3 + 0.15 * wave, 0.3 - 0.1 * wave, torch.full_like(wave, 0.3)], -1)


def square(z: float, base_color: torch.Tensor) -> Asset:
    """The square [-1, 1]^2 at height ``z``; its uv cover the texture, row 0 at y = 1."""
    vertices = torch.tensor([[-1.0, -1.0, z], [1.0, -1.0, z], [1.0, 1.0, z], [-1.0, 1.0, z]])
    uv = torch.tensor([[0.0, 1.0], [1.0, 1.0], [1.0, 0.0], [0.0, 0.0]])
    mesh = Mesh(vertices, torch.tensor([[0, 1, 2], [0, 2, 3]], dtype=torch.int32), uv=uv).with_normals()
    textures = TextureSet(base_color, roughness=1.0, metallic=0.0)
    return Asset(mesh, textures, Environment.constant([1.0, 1.0, 1.0]))


def texel_positions() -> torch.Tensor:
    at = (torch.arange(TEXELS) + 0.5) / TEXELS * 2.0 - 1.0
    x, y = at.expand(TEXELS, TEXELS), -at[:, None].expand(TEXELS, TEXELS)
    return torch.stack([x, y, torch.zeros_like(x)], -1)


def photographed(color_at=pattern, eyes=EYES) -> tuple[list[Crop], torch.Tensor]:
    """Photographs of the square, radiance ``color_at`` times smooth shading that differs between the views."""
    crops, poses = [], []
    for k, eye in enumerate(eyes):
        camera = Camera.from_fov(
            look_at(torch.tensor(eye), torch.zeros(3), torch.tensor([0.0, 1.0, 0.0])), 0.75, PIXELS, PIXELS
        )
        origin, direction = camera_rays(camera)
        at = origin - direction * (origin[..., 2:] / direction[..., 2:])
        inside = (at[..., :2].abs() <= 1.0).all(-1)
        shading = 0.9 + 0.3 * torch.sin(1.5 * at[..., :1] + k)
        color = linear_to_srgb((color_at(at) * shading).clamp(0.0, 1.0)) * inside[..., None]
        crops.append(Crop((255.0 * color + 0.5).to(torch.uint8), (255 * inside).to(torch.uint8), camera.intrinsics))
        poses.append(camera.c2w)
    return crops, torch.stack(poses)


def inner(values: torch.Tensor) -> torch.Tensor:
    """The texels that are not next to the outline, where no pixel counts."""
    return values[24:-24, 24:-24]


@pytest.mark.parametrize("unit", [1.0, 1000.0])
def test_the_detail_of_photographs_comes_into_the_base_color_and_their_shading_does_not(unit):
    truth = pattern(texel_positions())
    flat = square(0.0, torch.full((TEXELS, TEXELS, 3), 0.3))
    flat = replace(flat, mesh=replace(flat.mesh, vertices=unit * flat.mesh.vertices))
    crops, c2w = photographed()
    c2w[:, :3, 3] *= unit
    found, (before, after) = with_fine_detail(flat, crops, c2w, COARSE, held=[3])
    error = inner(found.textures.base_color - truth).square().mean().sqrt()
    start = inner(flat.textures.base_color - truth).square().mean().sqrt()
    assert error < 0.35 * start  # bilinear lookups of 1.3 pixels a texel lose about a fifth of the amplitude
    assert after < 0.4 * before
    means = inner(found.textures.base_color)[..., 2].unflatten(0, (8, -1)).unflatten(2, (8, -1)).mean((1, 3))
    assert (means / 0.3 - 1.0).abs().max() < 0.02  # shading varies by a third over the square


def test_what_the_views_do_not_share_is_not_added():
    generator = torch.Generator().manual_seed(3)
    noise = lambda at: (0.3 + 0.1 * torch.randn(at.shape, generator=generator)).clamp(0.02, 0.9)
    flat = square(0.0, torch.full((TEXELS, TEXELS, 3), 0.3))
    found, (before, after) = with_fine_detail(flat, *photographed(noise), COARSE, held=[3])
    assert found is flat and after >= before > 0.1


def test_without_a_held_out_photograph_nothing_changes():
    flat = square(0.0, torch.full((TEXELS, TEXELS, 3), 0.3))
    assert with_fine_detail(flat, *photographed(), COARSE, held=[])[0] is flat


def test_hidden_texels_keep_their_color():
    """A second square lies behind the first; in no photograph is any of it visible."""
    front, behind = (
        square(0.0, torch.full((TEXELS, TEXELS, 3), 0.3)),
        square(-0.2, torch.full((TEXELS, TEXELS, 3), 0.3)),
    )
    half = torch.tensor([0.5, 1.0])
    uv = torch.cat([front.mesh.uv * half, 0.4 * behind.mesh.uv + torch.tensor([0.55, 0.3])])
    vertices = torch.cat([front.mesh.vertices, behind.mesh.vertices * torch.tensor([0.4, 0.4, 1.0])])
    mesh = Mesh(vertices, torch.cat([front.mesh.faces, front.mesh.faces + 4]), uv=uv).with_normals()
    both = Asset(mesh, front.textures, front.environment)
    found, (before, after) = with_fine_detail(both, *photographed(), COARSE, held=[3])
    assert after < 0.6 * before
    changed = (found.textures.base_color - 0.3).abs().amax(-1)
    assert changed[:, :128].max() > 0.1
    assert changed[80:175, 145:240].max() == 0.0  # the square behind


def test_crops_of_low_resolution_do_not_blur_the_others():
    flat = square(0.0, torch.full((TEXELS, TEXELS, 3), 0.3))
    crops, c2w = photographed()
    sharp = with_fine_detail(flat, crops, c2w, COARSE, held=[3])[0]
    gray = lambda at: torch.full_like(at, 0.3)  # as if blurred
    small, small_c2w = photographed(gray, EYES[:1])
    size = round(1.3 * COARSE)
    color, mask = (
        torch.nn.functional.interpolate(v.float().permute(2, 0, 1)[None], (size, size), mode="area")[0].permute(1, 2, 0)
        for v in (small[0].color, small[0].mask[..., None])
    )
    low = Crop(color.to(torch.uint8), mask[..., 0].to(torch.uint8), small[0].intrinsics * size / PIXELS)
    mixed = with_fine_detail(flat, [*crops, low], torch.cat([c2w, small_c2w]), COARSE, held=[3])[0]
    contrast = [inner(a.textures.base_color)[..., 0].std() for a in (sharp, mixed)]
    assert contrast[1] > 0.9 * contrast[0]  # with equal weights 3/4
    none = with_fine_detail(flat, crops, c2w, round(PIXELS / 1.2), held=[3])[0]
    assert none is flat  # the fit's images show the same detail


def test_saturated_pixels_add_nothing():
    flat = square(0.0, torch.full((TEXELS, TEXELS, 3), 0.3))
    spots = lambda at: torch.where(pattern(at)[..., :1] > 0.4, 3.0, 0.3).expand_as(at)  # clipped at white
    found, _ = with_fine_detail(flat, *photographed(spots), COARSE, held=[3])
    assert found.textures.base_color.max() < 0.4  # the factor of a spot is 10, limited to 2


def test_a_refinement_ends_with_the_detail_of_its_photographs(monkeypatch):
    flat = square(0.0, torch.full((TEXELS, TEXELS, 3), 0.3))
    monkeypatch.setattr(pipeline, "REFINED", COARSE)
    crops, c2w = photographed()
    images, masks = (tuple(c.float() / 255.0 for c in values) for values in zip(*((c.color, c.mask) for c in crops)))
    views = reli3d.Views(images, masks, c2w, torch.stack([c.intrinsics for c in crops]), ("a", "b", "c", "d"))
    done = fit.Refinement(flat, Parts(1.0, 1.0, 1.0), (20.0, 20.0), (25.0, 25.0), (3,), c2w, ())
    monkeypatch.setattr(fit, "refine", lambda *_, **__: done)
    found = reli3d.refine(flat, views, steps=1)
    assert inner(found.textures.base_color - pattern(texel_positions())).square().mean().sqrt() < 0.05
    monkeypatch.setattr(fit, "refine", lambda *_, **__: replace(done, parts=Parts(0.0, 0.0, 0.0)))
    assert reli3d.refine(flat, views, steps=1) is flat


def test_nothing_is_added_beside_a_depth_edge():
    """A square in front of another; in the photographs its outline lies two pixels off, as of a wrong surface."""
    gray = torch.full((TEXELS, TEXELS, 3), 0.3)
    back, front = square(0.0, gray), square(0.5, gray)
    uv = torch.cat([back.mesh.uv * torch.tensor([0.5, 1.0]), 0.4 * front.mesh.uv + torch.tensor([0.55, 0.3])])
    vertices = torch.cat([back.mesh.vertices, front.mesh.vertices * torch.tensor([0.4, 0.4, 1.0])])
    mesh = Mesh(vertices, torch.cat([back.mesh.faces, back.mesh.faces + 4]), uv=uv).with_normals()
    both = Asset(mesh, back.textures, back.environment)
    half = 0.4 * 3.0 / 2.5 + 2.5 / 128  # of the front square's outline on the plane z = 0, and two pixels
    color = lambda at: torch.where((at[..., :2].abs() < half).all(-1, keepdim=True), 0.5, 0.2).expand_as(at)
    (crop,), c2w = photographed(color, EYES[:1])
    ratio, valid = log_ratio(both, RayScene(mesh.vertices, mesh.faces), crop, crop.camera(c2w[0]), COARSE)
    edge = (ratio.abs().amax(-1) > 0.2) & valid
    assert int(edge.sum()) == 0 and int(valid.sum()) > 20_000
