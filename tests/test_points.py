"""What a user may hand to the shader: rows, numbers, parts of points."""

import torch

from reli3d.render.environment import Environment
from reli3d.render.points import SurfacePoints
from reli3d.render.shading import shade
from tests.test_shading import points, sky


def test_one_row_and_plain_numbers_hold_for_all_points(device):
    """The same bits as written out, and gradients that are the rows' sums."""
    normal, wo = (v.to(device) for v in points(300))
    light = Environment(sky().radiance.to(device))
    color = torch.tensor([0.8, 0.5, 0.2], device=device)
    one = torch.full((300,), 0.3, device=device)
    full = [v.requires_grad_() for v in (color.expand(300, 3).contiguous(), one, one.clone())]
    want = shade(SurfacePoints(normal, normal, normal, *full), wo, light)
    assert torch.equal(want, shade(SurfacePoints(normal, normal, normal, color, 0.3, one[:1]), wo, light))
    few = [v.clone().requires_grad_() for v in (color[None], one.detach()[0], one.detach()[:1])]
    got = shade(SurfacePoints(normal, normal, normal, *few), wo, light)
    assert torch.equal(got, want)
    many, sums = torch.autograd.grad(want.sum(), full), torch.autograd.grad(got.sum(), few)
    for a, b in zip(many, sums):
        torch.testing.assert_close(a.sum(0), b.reshape(a.shape[1:]), rtol=1e-5, atol=1e-5)  # 300 float32 numbers
    flat = shade(SurfacePoints(normal, normal[0], normal[:1], 0.5, 0.3, 0), wo[0], light)
    rows = [v.expand(300, 3) for v in (normal[:1], normal[:1], color.new_full((1, 3), 0.5))]
    assert torch.equal(flat, shade(SurfacePoints(normal, *rows, one, 0 * one), wo[:1].expand(300, 3), light))
    part = SurfacePoints(normal, normal, normal, color, 0.3, 0.0)[100:200]
    assert len(part) == 100 and torch.equal(shade(part, wo[100:200], light, pixels=torch.arange(
        100, 200, dtype=torch.int32, device=device)), shade(SurfacePoints(normal, normal, normal, color, 0.3, 0.0), wo,
                                                            light)[100:200])  # fmt: skip
