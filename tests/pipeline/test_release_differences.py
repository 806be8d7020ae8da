"""Where the published release is wrong and this package is not, each with the size of the difference.

The release's results are its own values.  docs/model.md lists all differences.
"""

import math

import numpy as np
import pytest
import torch
from torch.nn.functional import grid_sample, normalize

from reli3d.geometry.bake import bake, rasterize_texels
from reli3d.geometry.mesh import Mesh
from reli3d.geometry.surface import extract_surface
from reli3d.render.environment import Environment
from reli3d.render.latlong import lat_long_directions, quarter_turn
from tests.support.meshes import volume


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
