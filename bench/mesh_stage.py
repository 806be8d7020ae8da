"""The mesh stage of ``reli3d-infer`` at the published sizes: a triplane in memory to a textured GLB in memory.

Grid query of the density, deformation and weight heads, extraction, atlas, bake with the material heads, dilation, GLB:
the pipeline's own functions on the published preset's triplane and heads with random weights.  The network before them
is cut to a stub that never runs.  The density's output is replaced by the bench's field, of 25,000 faces at resolution
80, so that there is a surface to texture; its head is evaluated all the same.
"""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import torch

from bench.surface import field
from bench.timing import Clock
from reli3d.geometry.camera import Camera
from reli3d.io.glb import glb_bytes
from reli3d.nn.field import TriplaneField
from reli3d.nn.model import Code, Reconstructor
from reli3d.nn.presets import OFFICIAL, BackboneSizes, EncoderSizes
from reli3d.nn.view_features import ViewMaps
from reli3d.pipeline import extract, texture
from reli3d.render.asset import Asset

PLANE = 384  # texels along a plane of the published triplane


class KnownSurface(Reconstructor):
    """The published heads; the grid's query evaluates them and then gives the bench's field as density."""

    def grid_density(self, code, axis):
        sdf = _field(len(axis) - 1, axis.device)
        return self.surface_density - 20.0 * sdf + 0.0 * super().grid_density(code, axis)


@lru_cache(1)
def _field(n, device):
    return field(n, device)


def random_field(device):
    """The heads of the published preset and a random channel-last triplane of its size."""
    torch.manual_seed(0)
    tiny = EncoderSizes(hidden=32, layers=1, heads=2, patch=14, grid=4, mask_channel=True)  # the trunk is not run
    preset = replace(
        OFFICIAL,
        plane_size=12,
        camera_width=32,
        encoder=tiny,
        backbone=BackboneSizes(heads=2, latents=8, blocks=1, basic_blocks=1, experts=0, experts_from=0, groups=4),
        illumination=replace(OFFICIAL.illumination, encoder=tiny, width=32, heads=2, layers=1),
    )
    model = KnownSurface(preset).to(device).eval()
    planes = torch.randn(1, 3, PLANE, PLANE, preset.upsampler.channels, device=device).movedim(-1, 2)
    nothing = torch.zeros(1, 4, device=device)
    maps = ViewMaps(nothing[None, None], nothing[None, None], Camera(torch.eye(4, device=device)[None], nothing, 1, 1))
    return TriplaneField(maps, model, Code(planes, nothing[None, None], nothing[None], nothing, nothing[:, :1]))


@torch.no_grad()
def stages(field, resolution, size) -> dict[str, float]:
    """Seconds of each part."""
    tick = Clock(field.code.triplane.device)
    mesh = extract(field, resolution)
    tick("surface")
    mesh, textures = texture(field, mesh, size, None)
    tick("textures")
    glb_bytes(Asset(mesh, textures))
    tick("glb")
    return tick.seconds


def mesh_stage(device, resolution, size):
    known = random_field(device)
    return lambda: stages(known, resolution, size), {"texels": size * size}


CASES = {"published_sizes": (mesh_stage, dict(resolution=80, size=1024))}
