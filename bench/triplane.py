"""Triplane sampling at the published size, 3 x 40 x 384^2 and 200,000 points, against torch's float32 grid_sample.

Both run with the number of threads that a case names.  ``channel_last`` planes are read in place, others are copied by
every call; ``half`` and ``bfloat16`` are the storage of our planes, sums are float32.
"""

import torch

from reli3d.geometry.triplane import sample_triplane


def grid_sample(planes, points):
    """The same features from torch."""
    out = []
    for k, axes in enumerate(([0, 1], [0, 2], [1, 2])):
        got = torch.nn.functional.grid_sample(planes[:, k], points[..., axes].unsqueeze(1), align_corners=False)
        out.append(got.squeeze(2).transpose(1, 2))
    return torch.cat(out, -1)


def inputs(device, n, size, backward):
    rng = torch.Generator(device).manual_seed(0)
    planes = torch.randn(1, 3, 40, size, size, generator=rng, device=device)
    points = torch.rand(1, n, 3, generator=rng, device=device) * 2 - 1
    return planes, points, torch.randn(1, n, 120, generator=rng, device=device) if backward else None


def timed(sample, planes, points, weights, threads):
    """Features of random points, with the gradient to the planes if there are ``weights``."""
    planes.requires_grad_(weights is not None)

    def step():
        before = torch.get_num_threads()
        torch.set_num_threads(threads)
        features = sample(planes, points)
        result = features if weights is None else torch.autograd.grad(features, planes, weights)
        torch.set_num_threads(before)
        return result

    return step, {"points": points.shape[1]}


def triplane(device, n, size, backward, threads, channel_last=False, dtype="float32"):
    planes, points, weights = inputs(device, n, size, backward)
    planes = planes.to(getattr(torch, dtype))
    if channel_last:
        planes = planes.movedim(2, -1).contiguous().movedim(-1, 2)
    return timed(sample_triplane, planes, points, weights, threads)


def torch_triplane(device, n, size, backward, threads, **_):
    return timed(grid_sample, *inputs(device, n, size, backward), threads)


CASES = {
    f"sample{'_grad' * backward}{variant}_{threads}": (
        triplane,
        dict(n=200_000, size=384, backward=backward, threads=threads, **options),
    )
    for backward in (False, True)
    for threads in (1, 2)
    for variant, options in {
        "": {},
        "_channel_last": {"channel_last": True},
        "_half": {"dtype": "float16"},
        "_bfloat16": {"dtype": "bfloat16"},
    }.items()
    if threads == 2 or not variant or variant == "_channel_last"
}
PEERS = dict.fromkeys(CASES, ("torch", torch_triplane))
