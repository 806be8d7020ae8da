"""Own backward passes, beyond the table of operations: inputs without a gradient, and
gradients that are not required."""

import pytest
import torch

from reli3d.render import shading, volume
from reli3d.render.environment import Environment
from reli3d.render.volume import composite
from tests.support.op_cases import shaded
from tests.support.rays import packed
from tests.support.surfaces import at, lit

NAMES = ("normal", "base_color", "roughness", "metallic", "radiance")


def shown(leaves):
    """Radiance of the table's hits; ``leaves`` by name, with all that ``shade`` takes."""
    names = ("normal", "ng", "wo", "base_color", "roughness", "metallic")
    return lit(at(leaves["normal"].detach(), *(leaves[k] for k in names)), Environment(leaves["radiance"]))


def hits(device, required=NAMES):
    values = {k: v.to(device) for k, v in shaded(40).items()}
    values = {"ng": values["normal"].clone(), **values}
    values["wo"] = torch.nn.functional.normalize(values["normal"] + 0.3, dim=-1)
    return {k: v.clone().requires_grad_(k in required) for k, v in values.items()}


def watched(monkeypatch, module, kernel):
    """Rows of the arrays that each launch of the ``kernel`` of a ``module`` writes to, the last of its arguments."""
    rows, launch = [], module.launch

    def spy(launched, n, args, device, **options):
        if launched.key.endswith(kernel):
            rows.append([len(a) for a in args if isinstance(a, torch.Tensor)])
        return launch(launched, n, args, device, **options)

    monkeypatch.setattr(module, "launch", spy)
    return rows


@pytest.mark.parametrize("required", [*((name,) for name in NAMES), ("base_color", "radiance")])
def test_shade_computes_only_required_gradients(device, monkeypatch, required):
    every = hits(device)
    grads = torch.autograd.grad(shown(every).square().sum(), [every[k] for k in NAMES])
    expected_grads = dict(zip(NAMES, grads, strict=True))
    rows = watched(monkeypatch, shading, "shade_adjoint_kernel")
    leaves = hits(device, required)
    shown(leaves).square().sum().backward()
    written = [[k for k, count in zip(NAMES, row[-5:], strict=True) if count] for row in rows]
    assert rows and all(names == list(required) for names in written)
    for k in required:
        expected = expected_grads[k]
        torch.testing.assert_close(leaves[k].grad, expected, rtol=1e-5, atol=1e-6 * float(expected.abs().max()))


@pytest.mark.parametrize("required", [(True, False), (False, True)])
def test_composite_computes_only_required_gradients(device, monkeypatch, required):
    samples, density, color = packed([3, 0, 40], device)
    both = [v.clone().requires_grad_() for v in (density, color)]
    expected_grads = torch.autograd.grad(composite(*both, samples).color.square().sum(), both)
    rows = watched(monkeypatch, volume, "composite_adjoint_kernel")
    leaves = [v.requires_grad_(a) for v, a in zip((density, color), required, strict=True)]
    composite(*leaves, samples).color.square().sum().backward()
    assert rows and all([bool(count) for count in row[-2:]] == list(required) for row in rows)
    for leaf, a, expected in zip(leaves, required, expected_grads, strict=True):
        assert torch.equal(leaf.grad, expected) if a else leaf.grad is None
