"""Shading normals from bump normals."""

import numpy as np
import torch

from reli3d.render.bump import radial_bump


def test_radial_bump_matches_the_published_frame(goldens):
    data = np.load(goldens / "radial_bump.npz")
    keys = {k: torch.as_tensor(data[k]) for k in data.files}
    got = radial_bump(keys["position"], keys["geometry_normal"], keys["surface_normal"])
    torch.testing.assert_close(got, keys["shading_normal"], rtol=1e-5, atol=2e-6)  # four float32 normalisations


def test_a_flat_bump_is_the_normal():
    generator = torch.Generator().manual_seed(3)
    position, normal = torch.randn(500, 3, generator=generator), torch.randn(500, 3, generator=generator)
    normal = torch.nn.functional.normalize(normal, dim=-1)
    flat = torch.tensor([0.0, 0.0, 1.0]).expand(500, 3)
    torch.testing.assert_close(radial_bump(position, normal, flat), normal, rtol=0, atol=1e-6)
