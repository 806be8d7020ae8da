"""The crossing between torch and Warp: slices, gradients, ownership of buffers, checks."""

import os
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor

import pytest
import torch
import warp as wp

from reli3d import _bridge
from reli3d.kernels import cache
from tests.support.checkout import ROOT

wp.set_module_options({"enable_backward": True, "cpu_compiler_flags": ""})

SIZES = [1, 7, _bridge.SLICE_MIN * _bridge.SLICES + 5]  # one thread, one slice, all slices with a remainder


@wp.kernel
def gather_scale_kernel(
    start: int,
    table: wp.array[wp.vec3],
    index: wp.array[int],
    weight: wp.array[float],
    factor: float,
    value: wp.array[wp.vec3],  # out
    parity: wp.array[int],  # out
):
    i = start + wp.tid()
    value[i] = factor * weight[i] * table[index[i]]
    parity[i] = index[i] % 2


@wp.kernel
def square_kernel(
    start: int,
    x: wp.array[float],
    y: wp.array[float],  # out
):
    i = start + wp.tid()
    y[i] = x[i] * x[i]


@wp.kernel
def count_kernel(
    start: int,
    visits: wp.array[int],  # out
):
    i = start + wp.tid()
    visits[i] = visits[i] + i


def gather_scale(table, index, weight, factor):
    n = len(index)
    return _bridge.call(gather_scale_kernel, n, [table, index, weight, factor], [(n,), (n,)], shared=(0,))


def square(x):
    return _bridge.call(square_kernel, len(x), [x], [(len(x),)])[0]


def operands(n, device, rows=11):
    rng = torch.Generator().manual_seed(n)
    table = torch.randn(rows, 3, generator=rng).to(device).requires_grad_()
    index = torch.randint(rows, (n,), generator=rng, dtype=torch.int32).to(device)
    weight = torch.randn(n, generator=rng).to(device).requires_grad_()
    g = torch.randn(n, 3, generator=rng).to(device)
    return table, index, weight, g


@pytest.mark.parametrize("n, slice_min, parts", [(5, 1, 5), (64, 1, 16), (64, 8, 8), (7, 8, 1), (1 << 20, 8, 16)])
def test_few_heavy_threads_are_cut_by_their_own_minimum(device, threads, n, slice_min, parts):
    assert len(_bridge.slices(n, slice_min)) == parts
    threads(2)
    seen = _bridge.over_slices(n, lambda k, start, count: (start, count), slice_min=slice_min)
    assert seen == _bridge.slices(n, slice_min)
    visits = torch.ones(n, dtype=torch.int32, device=device)
    _bridge.launch(count_kernel, n, [visits], device, slice_min=slice_min)
    assert torch.equal(visits, 1 + torch.arange(n, dtype=torch.int32, device=device))


@pytest.mark.parametrize("n", SIZES)
def test_values_and_gradients_match_torch_in_float64(device, n):
    table, index, weight, g = operands(n, device)
    value, parity = gather_scale(table, index, weight, 1.7)
    got = torch.autograd.grad(value, (table, weight), g)
    table64, weight64 = table.detach().double().requires_grad_(), weight.detach().double().requires_grad_()
    value64 = 1.7 * weight64[:, None] * table64[index.long()]
    ref = torch.autograd.grad(value64, (table64, weight64), g.double())
    torch.testing.assert_close(value.double(), value64, rtol=3e-7, atol=0)  # two float32 roundings
    assert torch.equal(parity, index % 2) and not parity.requires_grad
    # A table row sums n / 11 float32 terms of size 1, slice by slice: rounding stays below 2e-6 of their norm.
    torch.testing.assert_close(got[0].double(), ref[0], rtol=1e-5, atol=2e-6 * n**0.5)
    torch.testing.assert_close(got[1].double(), ref[1], rtol=1e-5, atol=1e-5)  # three products of size 1 may cancel


def test_every_slice_adds_into_its_own_buffer(monkeypatch, threads):
    """Two threads that add into one buffer lose additions, rarely enough that a comparison of sums would miss it."""
    threads(2)
    buffers, launch = [], wp.launch

    def spy(*args, **options):
        if options.get("adjoint"):
            buffers.append(options["adj_inputs"][1].grad or options["adj_inputs"][1].data)
        return launch(*args, **options)

    table, index, weight, g = operands(SIZES[-1], torch.device("cpu"))
    value, _ = gather_scale(table, index, weight, 1.0)
    monkeypatch.setattr(wp, "launch", spy)
    torch.autograd.grad(value, table, g)
    assert len(set(buffers)) == len(buffers) == _bridge.SLICES


def test_gradients_of_large_tables_take_bounded_memory(monkeypatch):
    monkeypatch.setattr(_bridge, "ACCUMULATED", 64)
    shapes, launch = [], wp.launch

    def spy(*args, **options):
        shapes.append(args[1])
        return launch(*args, **options)

    table, index, weight, g = operands(SIZES[-1], torch.device("cpu"))
    value, _ = gather_scale(table, index, weight, 1.0)
    expected = torch.autograd.grad(value, table, g, retain_graph=True)[0]
    monkeypatch.setattr(wp, "launch", spy)
    got = torch.autograd.grad(value, table, g)[0]
    assert len(shapes) <= max(1, 64 // table.numel()) < _bridge.SLICES
    torch.testing.assert_close(got, expected, rtol=1e-5, atol=1e-4)  # sums in another order


def test_error_in_a_slice_reaches_the_caller():
    def work(k, start, count):
        raise RuntimeError(f"slice {k}")

    with pytest.raises(RuntimeError, match="slice"):
        _bridge.over_slices(1 << 16, work)


def test_slices_within_slices_come_to_an_end(threads):
    threads(2)
    inner = _bridge.over_slices(1 << 16, lambda k, a, c: sum(_bridge.over_slices(1 << 15, lambda k, a, c: c)))
    assert inner == [1 << 15] * _bridge.SLICES


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork, as the loaders of torch use it on Linux")
def test_a_forked_child_can_launch_after_its_parent():
    code = (
        "import os, torch\n"
        "torch.set_num_threads(2)\n"  # whatever OMP_NUM_THREADS is: with one thread there is no pool
        "from tests.bridge import test_bridge\n"
        "x = torch.full((1 << 16,), 2.0)\n"
        "test_bridge.square(x)\n"  # starts the thread pool of the parent, which a fork does not copy
        "child = os.fork()\n"
        "if child == 0:\n"
        "    import signal; signal.alarm(20)\n"  # a child that waits for threads it does not have is ended
        "    ok = test_bridge.square(x)[-1].item() == 4\n"  # no reduction: the threads of OpenMP are not copied either
        "    os._exit(0 if ok else 3)\n"
        "assert os.waitpid(child, 0)[1] == 0, 'the child failed'\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120, cwd=ROOT)
    assert done.returncode == 0, done.stderr


def test_modules_load_together_and_are_known_as_compiled(tmp_path, monkeypatch, device):
    from reli3d.kernels import distance, noise

    _bridge.load_modules([distance, noise], device)
    assert cache.compiled([distance, noise], device.type)
    monkeypatch.setattr(wp.config, "kernel_cache_dir", str(tmp_path))
    assert not cache.compiled([distance, noise], device.type)


@pytest.mark.parametrize("count", [1, 2, 5])
def test_blocks_of_rows_come_in_order_without_gradient_and_with_one_torch_thread(threads, count):
    threads(count)
    weight = torch.ones(3, requires_grad=True)
    seen = _bridge.over_rows(10, 4, lambda a, b: (a, b, torch.get_num_threads(), (weight * 2).requires_grad))
    assert seen == [(0, 4, 1, False), (4, 8, 1, False), (8, 10, 1, False)]
    assert torch.get_num_threads() == count and torch.is_grad_enabled()
    assert _bridge.over_rows(0, 4, lambda a, b: (a, b)) == []


def test_threads_load_a_kernel_one_after_the_other(threads, monkeypatch):
    """Slices that launch kernels of their own, as the ray caster's do: Warp would compile a module in each thread."""
    threads(4)
    began, concurrent_with_first = [], []
    load = wp.Module.load

    def slow_at_first(module, *args, **kwargs):
        began.append(1)
        if len(began) == 1:
            time.sleep(0.1)  # as if it compiled
            concurrent_with_first.append(len(began) - 1)
        return load(module, *args, **kwargs)

    monkeypatch.setattr(wp.Module, "load", slow_at_first)
    visits = torch.zeros(8 * _bridge.SLICE_MIN, dtype=torch.int32)

    def work(k, start, count):
        part = visits[start : start + count]
        _bridge.launch(count_kernel, count, [part], part.device, slice_min=count)

    _bridge.over_slices(len(visits), work)
    assert concurrent_with_first == [0] and len(began) >= 8
    assert torch.equal(visits, torch.arange(len(visits), dtype=torch.int32) % _bridge.SLICE_MIN)


def test_threads_start_warp_once(monkeypatch):
    """Warp forgets its modules' hashes while it starts; a thread that already loads one would stumble over that."""
    started = []
    monkeypatch.setattr(wp, "init", lambda: (time.sleep(0.05), started.append(1)))
    cache._start.cache_clear()
    with ThreadPoolExecutor(4) as pool:
        list(pool.map(lambda _: (cache.initialize(), started.append(0)), range(4)))
    assert started == [1, 0, 0, 0, 0]
