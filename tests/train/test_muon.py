"""Muon against torch's, which knows matrices alone."""

import pytest
import torch

from reli3d.train.muon import MOMENTUM, Muon


def run(optimizer, parameter, gradients):
    for gradient in gradients:
        parameter.grad = gradient.reshape(parameter.shape).clone()
        optimizer.step()
    return parameter.detach()


if hasattr(torch.optim, "Muon"):  # since torch 2.9

    @pytest.mark.parametrize("shape", [(16, 24), (40, 16), (16, 8, 3, 3)])
    def test_matrices_and_convolutions_follow_muon_of_torch(shape):
        generator = torch.Generator().manual_seed(0)
        start = torch.randn(shape, generator=generator)
        gradients = [torch.randn(shape, generator=generator) for _ in range(4)]
        options = {"lr": 0.02, "weight_decay": 0.1}
        got = torch.nn.Parameter(start.clone())
        want = torch.nn.Parameter(start.flatten(1).clone())
        peer = torch.optim.Muon([want], momentum=MOMENTUM, adjust_lr_fn="match_rms_adamw", **options)
        change = run(Muon([got], **options), got, gradients).flatten(1) - start.flatten(1)
        expected = run(peer, want, gradients) - start.flatten(1)
        assert float(expected.norm()) > 0.1
        assert float((change - expected).norm() / expected.norm()) < 0.02  # torch's iteration is in bfloat16


def test_vectors_small_matrices_and_fast_groups_follow_adamw():
    generator = torch.Generator().manual_seed(1)
    for shape, times in (((12,), 1.0), ((12, 30), 1.0), ((16, 24), 10.0)):
        start = torch.randn(shape, generator=generator)
        gradients = [torch.randn(shape, generator=generator) for _ in range(3)]
        got, want = (torch.nn.Parameter(start.clone()) for _ in range(2))
        run(Muon([{"params": [got], "times": times}], lr=0.01), got, gradients)
        run(torch.optim.AdamW([want], lr=0.01), want, gradients)
        torch.testing.assert_close(got, want, rtol=0, atol=0)


def test_it_resumes_bitwise():
    generator = torch.Generator().manual_seed(2)
    start = torch.randn(16, 24, generator=generator)
    gradients = [torch.randn(16, 24, generator=generator) for _ in range(4)]
    whole, halves = (torch.nn.Parameter(start.clone()) for _ in range(2))
    run(Muon([whole], lr=0.01), whole, gradients)
    first = Muon([halves], lr=0.01)
    run(first, halves, gradients[:2])
    second = Muon([halves], lr=0.01)
    second.load_state_dict(first.state_dict())
    run(second, halves, gradients[2:])
    assert torch.equal(whole, halves)
