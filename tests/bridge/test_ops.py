"""What holds for every public operation, over the table of ``tests/support/op_cases.py``."""

import importlib
import itertools
import pkgutil

import pytest
import torch
import warp as wp

from reli3d import kernels
from tests.support import reference
from tests.support.op_cases import CASES, Case, N, rng

DIFFERENTIABLE = [name for name, case in CASES.items() if case.grads]
ROWS = 40  # rows where their number does not matter
STEP = 3e-5  # of finite differences of derivatives: longer steps cross kinks of the mean absolute deviation


def leaves_of(case: Case, device, n: int = ROWS, requires_grad=None) -> dict:
    requires_grad = case.grads if requires_grad is None else requires_grad
    return {k: v.to(device).requires_grad_(k in requires_grad) for k, v in case.inputs(n).items()}


def strided(leaves: dict) -> dict:
    """The same values, no two of a tensor side by side."""
    return {
        k: torch.stack([v.detach(), -v.detach()], -1)[..., 0].requires_grad_(v.requires_grad) for k, v in leaves.items()
    }


def weighed(outs) -> list[tuple[torch.Tensor, torch.Tensor]]:
    """Every differentiable output and random weights, the same numbers on any device."""
    pairs = [(out, torch.rand(out.shape, generator=rng(k)) - 0.3) for k, out in enumerate(outs)]
    return [(out, weight.to(out.device)) for out, weight in pairs if out.is_floating_point() and out.requires_grad]


def loss_of(outs) -> torch.Tensor:
    return sum((out * weight).sum() for out, weight in weighed(outs))


def gradients(case: Case, leaves: dict, outs, **options) -> dict:
    """Of the leaves by name; what comes in is not modified."""
    names = [k for k in leaves if leaves[k].requires_grad]
    out, incoming = zip(*weighed(outs), strict=True)
    before = [weight.clone() for weight in incoming]
    grads = torch.autograd.grad(out, [leaves[k] for k in names], incoming, **options)
    assert all(torch.equal(a, b) and a._version == 0 for a, b in zip(incoming, before, strict=True))
    return dict(zip(names, grads, strict=True))


def same(a: torch.Tensor, b: torch.Tensor) -> bool:
    """Equal bits; on CUDA, whose sums take any order, 1e-4."""
    return torch.equal(a, b) if a.device.type == "cpu" else reference.fraction_within(a, b) >= 0.999


@pytest.mark.parametrize("name", CASES)
def test_strides_do_not_matter_and_inputs_are_neither_modified_nor_returned(device, name):
    """What ``torch.library.opcheck`` requires of a schema: no input and no incoming gradient has other bits or another
    version afterwards, and no output uses the memory of an input."""
    case = CASES[name]
    plain = leaves_of(case, device)
    before = {k: (v.detach().clone(), v._version) for k, v in plain.items()}
    spread = strided(plain)
    assert all(v.numel() < 2 or not v.is_contiguous() for v in spread.values())
    outs, others = case.run(**plain), case.run(**spread)
    assert all(same(a, b) for a, b in zip(outs, others, strict=True))
    if case.grads:
        first, second = gradients(case, plain, outs), gradients(case, spread, others)
        assert all(same(first[k], second[k]) for k in first)
    assert all(torch.equal(plain[k], bits) and plain[k]._version == version for k, (bits, version) in before.items())
    owned = {v.untyped_storage().data_ptr() for v in plain.values()}
    # a ray's origin is a view of its pose, which torch keeps count of
    assert name == "camera_rays" or not any(out.untyped_storage().data_ptr() in owned for out in outs)


@pytest.mark.parametrize("name", DIFFERENTIABLE)
def test_one_gradient_alone_is_that_of_all_and_backward_can_be_repeated(device, name):
    case = CASES[name]
    every = leaves_of(case, device)
    outs = case.run(**every)
    expected_grads = gradients(case, every, outs, retain_graph=True)
    again = gradients(case, every, outs)
    assert all(same(expected_grads[k], again[k]) for k in expected_grads)
    assert all(float(g.abs().max()) > 0.0 for g in expected_grads.values())
    for k in case.grads:
        alone = leaves_of(case, device, requires_grad=(k,))
        loss_of(case.run(**alone)).backward()
        assert same(alone[k].grad, expected_grads[k]), k
        assert all(v.grad is None for other, v in alone.items() if other != k)
    none = case.run(**leaves_of(case, device, requires_grad=()))
    assert not any(out.requires_grad for out in none)


@pytest.mark.parametrize("name", DIFFERENTIABLE)
def test_an_edit_in_place_is_an_error_or_harmless(device, name):
    """Never a gradient at values that are no longer those of the forward pass."""
    case, refused = CASES[name], 0
    plain = leaves_of(case, device)
    expected_grads = gradients(case, plain, case.run(**plain))
    for k in case.grads:
        leaves = leaves_of(case, device)
        held = {other: v * 1.0 for other, v in leaves.items()}
        outs = case.run(**held)
        with torch.no_grad():
            held[k].mul_(0.5)
        try:
            got = torch.autograd.grad(loss_of(outs), [leaves[other] for other in case.grads])
        except RuntimeError as error:
            assert "inplace" in str(error)
            refused += 1
            continue
        for a, other in zip(got, case.grads, strict=True):
            torch.testing.assert_close(
                a, expected_grads[other], rtol=1e-5, atol=1e-6 * float(expected_grads[other].abs().max())
            )
    # torch may keep copies of inputs
    assert refused or case.second == case.grads or name == "taubin_smooth"


@pytest.mark.slow  # 20 s of tracing
@pytest.mark.parametrize("held_out", [True, False])
def test_a_compiled_function_around_an_operation_is_bitwise_equal(device, held_out):
    case = CASES["shade"]
    run = torch.compiler.disable(case.run) if held_out else case.run

    def image(**leaves):
        return run(**{**leaves, "base_color": leaves["base_color"].square()})[0].square() + 1.0

    results = []
    for f in (image, torch.compile(image, backend="eager")):
        leaves = leaves_of(case, device)
        out = f(**leaves)
        results.append([out, *torch.autograd.grad(out.sum(), [leaves[k] for k in case.grads])])
    torch._dynamo.reset()
    assert all(same(a, b) for a, b in zip(*results, strict=True))


@pytest.mark.parametrize("kind", [torch.float64, torch.float16])
@pytest.mark.parametrize("name", CASES)
def test_other_floating_point_types_are_named_or_taken(device, name, kind):
    case = CASES[name]
    for k, value in leaves_of(case, device, requires_grad=()).items():
        changed = {**leaves_of(case, device, requires_grad=()), k: value.to(kind)}
        if k in case.dtypes and (kind == torch.float16 or name != "sample_triplane"):
            assert all(bool(torch.isfinite(out).all()) for out in case.run(**changed))
            continue
        with pytest.raises(TypeError, match=r"^[\w.]+: expected .*got torch.float(64|16|32)"):
            case.run(**changed)


@pytest.mark.parametrize("name", [name for name, case in CASES.items() if case.rows])
def test_no_rows_are_data(device, name):
    case = CASES[name]
    leaves = leaves_of(case, device, 0)
    outs = case.run(**leaves)
    assert all(out.isfinite().all() for out in outs if out.is_floating_point())
    if case.grads:
        for k, g in gradients(case, leaves, outs).items():
            assert g.shape == leaves[k].shape and not bool(g.any()), k


@pytest.mark.parametrize("of", [torch.clone, torch.square])
@pytest.mark.parametrize("name", DIFFERENTIABLE)
def test_second_derivatives_are_right_or_refused(device, name, of):
    """Of every gradient in every input: those of kernels raise, those of plain torch equal differences of the first.
    Of a loss that is linear in the results too: then the incoming gradient is a constant."""
    case, noise = CASES[name], rng(4)
    moves = {k: torch.randn(v.shape, generator=noise).to(device) for k, v in leaves_of(case, device).items()}

    def derivative(leaves, k, **options):
        """Along a random direction of the input ``k``."""
        loss = loss_of(tuple(of(out) for out in case.run(**leaves) if out.is_floating_point()))
        return (torch.autograd.grad(loss, leaves[k], **options)[0] * moves[k].to(loss.device)).double()

    def bend(k, other, device=device):
        leaves = strided(leaves_of(case, device))  # the second derivative is taken of the inputs, not of copies
        along = derivative(leaves, k, create_graph=True).sum()
        return torch.autograd.grad(along, leaves[other], allow_unused=True)[0] if along.requires_grad else None

    for k, other in itertools.product(case.grads, repeat=2):
        try:
            got = bend(k, other)
        except RuntimeError as error:
            refused = "second derivatives are not supported" in str(error) or isinstance(
                error, NotImplementedError
            )  # ours; torch's
            assert refused and k not in case.second, (k, other)
            continue
        if got is not None and torch.device(device).type == "cuda":  # its sums take any order: noise over the step
            assert k in case.second and reference.fraction_within(got, bend(k, other, "cpu"), 1e-3) >= 0.999, (k, other)
            continue
        ends = []
        for sign in (1.0, -1.0):
            moved = leaves_of(case, device)
            moved[other] = (moved[other].detach() + sign * STEP * moves[other]).requires_grad_()
            ends.append(derivative(moved, k))
        if got is None:  # linear, or no output depends on both
            assert same(*ends), (k, other)
            continue
        got, expected = (got * moves[other]).double(), float((ends[0] - ends[1]).sum()) / (2.0 * STEP)
        assert k in case.second, (k, other)
        # float32 differences over the step
        assert abs(float(got.sum()) - expected) < 2e-2 * float(got.abs().sum()) + 1e-3, (k, other)


@pytest.mark.parametrize("name", CASES)
def test_one_two_and_five_threads_are_bitwise_identical(threads, name):
    case, results = CASES[name], []
    for count in (1, 2, 5):
        threads(count)
        leaves = leaves_of(case, "cpu", N)
        outs = case.run(**leaves)
        results.append([*outs, *(gradients(case, leaves, outs).values() if case.grads else ())])
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other, strict=True))


# differences of nearly equal numbers, whose products and sums CUDA contracts: 0.9987 and 0.99875 on an H100
CONTRACTED = {("views", "output 5"): 0.998, ("surface_points", "bary"): 0.998}


@pytest.mark.parametrize("name", CASES)
def test_cpu_and_cuda_agree(name):
    if not torch.cuda.is_available():
        pytest.skip("needs CUDA")
    case, results = CASES[name], []
    for device in ("cpu", "cuda"):
        leaves = leaves_of(case, device, N)
        outs = case.run(**leaves)
        grads = gradients(case, leaves, outs) if case.grads else {}
        results.append({**{f"output {k}": out.detach().cpu() for k, out in enumerate(outs)}, **grads})
    for key, expected in results[0].items():
        got = results[1][key].cpu()
        assert got.shape == expected.shape, key
        floating, equal = expected.is_floating_point(), (got == expected).double()
        fraction = reference.fraction_within(got, expected) if floating else float(equal.mean())
        assert fraction >= CONTRACTED.get((name, key), 0.999), (key, fraction)


def test_no_kernel_is_left_out(monkeypatch):
    """The table launches every kernel but those of other parts and of sizes and backends that it does not reach."""
    launched, launch = set(), wp.launch
    monkeypatch.setattr(wp, "launch", lambda kernel, *a, **k: (launched.add(kernel.key), launch(kernel, *a, **k))[1])
    for case in CASES.values():
        leaves = leaves_of(case, "cpu")
        outs = case.run(**leaves)
        if case.grads:
            gradients(case, leaves, outs)
    found = set()
    for module in pkgutil.iter_modules(kernels.__path__):
        # of data; CPU alone; of counts
        if module.name not in ("noise", "distance", "charts", "allocation"):
            values = vars(importlib.import_module(f"reli3d.kernels.{module.name}")).values()
            found |= {v.key for v in values if isinstance(v, wp.Kernel)}
    assert found - launched == {
        "ray_key_kernel",  # many rays, before Embree
        "sample_rows_kernel",  # triplanes beyond a cache
    }
