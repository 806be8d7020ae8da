"""Interface between torch and Warp: zero-copy views, streams, parallel CPU launches and adjoints.

Every kernel takes ``start: int`` first and processes ``i = start + wp.tid()``.  Warp runs a CPU launch on one thread
and releases the GIL, so large CPU launches are split into slices over a thread pool.  The number of slices depends only
on the size and the operation, so results are bitwise identical for any number of threads.

Outputs must be disjoint per ``i``, because Warp's CPU atomics are not atomic.  In the backward pass, each input that
several ``i`` read (listed in ``shared``) has one accumulator per slice; they are summed in the order of the slices.
"""

import contextlib
import functools
import os
import threading
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import fields, is_dataclass, replace
from functools import cache, lru_cache
from types import ModuleType
from typing import Any, TypeVar, cast

import numpy as np
import torch
import warp as wp
from torch import Tensor

from reli3d.kernels.cache import CPU_BLOCK, LOADING, initialize, repaired

WORKER = "reli3d-slice"  # name prefix of the pool's threads
SLICES = 16  # per launch: balances uneven work on 2 to 8 cores; each adds 20 us of launch overhead
COMPILERS = 4  # modules compiled concurrently; each thread builds its own precompiled header, 1.5 CPU seconds
ACCUMULATED = 1 << 27  # elements of the gradients of one input that the slices of a launch accumulate, all together
SLICE_MIN = 1024  # kernel threads per slice: below this a slice costs about as much to launch as to run

T = TypeVar("T")
F = TypeVar("F", bound=Callable)


@lru_cache(1)
def pool() -> ThreadPoolExecutor:
    """Thread pool for slices and blocks; torch runs single-threaded inside its threads."""
    threads = max(1, torch.get_num_threads())
    made = ThreadPoolExecutor(max_workers=threads, thread_name_prefix=WORKER)
    started = threading.Barrier(threads)

    def start(_) -> None:
        started.wait()  # one task per thread
        torch.get_num_threads()  # a thread inherits torch's number at its first call, which must precede the next line
        torch.set_num_threads(1)

    list(made.map(start, range(threads)))
    torch.set_num_threads(threads)  # restores the default of later threads; the pool's keep theirs
    return made


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=pool.cache_clear)  # threads do not survive a fork: the child starts its own pool


def slices(n: int, slice_min: int = SLICE_MIN) -> list[tuple[int, int]]:
    """``[(start, count), ...]`` of a CPU launch over ``n`` threads; a function of ``n`` and ``slice_min`` only."""
    parts = max(1, min(SLICES, n // slice_min))
    edges = [n * k // parts for k in range(parts + 1)]
    return [(a, b - a) for a, b in zip(edges[:-1], edges[1:], strict=True)]


def slice_of_accumulators(n: int, slice_min: int, elements: int) -> int:
    """The ``slice_min`` above which the slices of ``n`` threads accumulate ``elements`` each, ACCUMULATED in total."""
    return max(slice_min, -(-n // max(1, ACCUMULATED // max(1, elements))))


def over_slices(n: int, work, *, slice_min: int = SLICE_MIN) -> list:
    """``[work(k, start, count), ...]`` for every slice of ``n``, on the thread pool if there is more than one."""
    parts = slices(n, slice_min)
    if len(parts) == 1:
        return [work(0, *parts[0])]
    return _in_pool(lambda item: work(item[0], *item[1]), enumerate(parts))


def over_rows(n: int, rows: int, work) -> list:
    """``[work(start, stop), ...]`` for blocks of ``rows`` of ``n`` rows, on the thread pool; no gradient is recorded.

    For chains of torch operations, whose intermediate values then fit the cache of a core.  Torch evaluates a block in
    one thread, so results are bitwise identical for any number of threads.
    """

    def block(start: int):
        with torch.no_grad():  # grad mode is thread-local
            return work(start, min(start + rows, n))

    return _in_pool(block, range(0, n, rows))


def _in_pool(work, items: Iterable) -> list:
    return [work(item) for item in items] if serial() else list(pool().map(work, items))


def serial() -> bool:
    """Whether work of the calling thread is not distributed over the pool.

    True if torch uses one thread, in threads of the pool (which would deadlock), and in Warp's debug mode, where
    concurrent kernels crash on a static pointer (``shared_tile_storage`` in Warp's tile.h) that release builds lack.
    """
    if wp.config.mode == "debug":
        return True
    return torch.get_num_threads() == 1 or threading.current_thread().name.startswith(WORKER)


def full_precision(function: F) -> F:
    """Decorator: runs ``function`` with autocast disabled on every device, so that matrix products stay in float32.

    The backward pass uses the autocast state of its caller, as for any other operation.
    """

    @functools.wraps(function)
    def wrapper(*args, **kwargs):
        run = function
        for kind in ("cpu", "cuda"):
            if torch.is_autocast_enabled(kind):
                run = torch.autocast(kind, enabled=False)(run)
        return run(*args, **kwargs)

    return cast(F, wrapper)


def indexed(device: torch.device) -> torch.device:
    """``device`` as tensors name it: ``cuda`` without an index is torch's current CUDA device."""
    if device.type == "cuda" and device.index is None:
        return torch.device("cuda", torch.cuda.current_device())
    return device


@contextlib.contextmanager
def stream(device: torch.device):
    """Context in which Warp launches on torch's current CUDA stream; yields the Warp device name."""
    initialize()
    device = indexed(device)
    if device.type == "cuda":
        with wp.ScopedStream(wp.stream_from_torch(torch.cuda.current_stream(device))):
            yield str(wp.device_from_torch(device))
    else:
        yield "cpu"


def view(tensor: Tensor, dtype):
    """Zero-copy Warp array descriptor of a contiguous tensor, without gradient."""
    if not tensor.numel():  # torch calls it contiguous whatever its strides
        tensor = torch.empty(tensor.shape, dtype=tensor.dtype, device=tensor.device)
    return wp.from_torch(tensor.detach(), dtype=dtype, requires_grad=False, return_ctype=True)


def array_of(tensor: Tensor, dtype) -> wp.array:
    """Warp array on the memory of a contiguous tensor, without gradient, for objects that Warp keeps."""
    return cast(wp.array, wp.from_torch(tensor, dtype=dtype, requires_grad=False))


@cache
def _element_types(kernel) -> list:
    """Element types of the array arguments of ``kernel`` after ``start``, in order; of other arguments any value."""
    return [getattr(argument.type, "dtype", None) for argument in kernel.adj.args[1:]]


def _views(args: Sequence, types: Sequence) -> list:
    return [view(a, dtype) if isinstance(a, Tensor) else a for a, dtype in zip(args, types, strict=True)]


def struct_of(kind, **fields):
    """Warp struct ``kind`` with tensors or plain values as fields; it keeps the tensors alive.

    Tensors must be contiguous and have no gradient: inputs that :func:`call` differentiates are separate arguments.
    """
    initialize()
    made = kind()
    native = made.__ctype__()  # Warp's own setters require arrays, which take twice as long to create
    for name, value in fields.items():
        setattr(native, name, view(value, kind.vars[name].type.dtype) if isinstance(value, Tensor) else value)
    vars(made)["tensors"] = [v for v in fields.values() if isinstance(v, Tensor)]  # keeps their memory alive
    return made


def _check_device(args: Iterable, device: torch.device) -> None:
    """Raises ValueError for a tensor that is not on ``device``."""
    device = indexed(device)
    for value in args:
        for tensor in (value,) if isinstance(value, Tensor) else getattr(value, "tensors", ()):
            if tensor.device != device:
                raise ValueError(f"tensor {tuple(tensor.shape)}: expected device {device}, got {tensor.device}")


def empty(shape: Sequence[int], dtype, device: torch.device) -> Tensor:
    """Uninitialized torch tensor for a Warp array of ``shape`` and type ``dtype``."""
    scalar, tail = getattr(dtype, "_wp_scalar_type_", dtype), getattr(dtype, "_shape_", ())
    return torch.empty((*shape, *tail), dtype=wp.dtype_to_torch(scalar), device=device)


def load_modules(modules: Sequence[ModuleType], device: torch.device) -> None:
    """Loads kernel modules (:mod:`reli3d.kernels`), compiling those missing from the kernel cache concurrently.

    Otherwise every module is compiled at its first launch.  The compiler releases the GIL.
    """
    with stream(device) as name:
        loaded = [wp.get_module(m.__name__) for m in modules]
        block = CPU_BLOCK if name == "cpu" else None
        try:
            wp.force_load(name, loaded, block_dim=block, max_workers=min(os.cpu_count() or 1, COMPILERS))
        except Exception:  # Warp raises no narrower class
            for module in loaded:
                repaired(module, block, lambda m=module: wp.force_load(name, [m], block_dim=block))


def _load(kernel) -> None:
    """Loads the module of a kernel on the CPU."""
    with LOADING:
        repaired(kernel.module, CPU_BLOCK, lambda: kernel.module.load(wp.get_device("cpu"), block_dim=CPU_BLOCK))


def launch(kernel, n: int, args: Sequence, device: torch.device, *, slice_min: int = SLICE_MIN) -> None:
    """Launches ``kernel(start, *args)`` over ``n`` threads, without gradient.

    args: contiguous tensors on ``device``, not copied; views of them (:func:`view`); plain values.
    slice_min: least number of threads per CPU slice, small for kernels with much work per thread.
    """
    if n == 0:
        return
    _check_device(args, device)
    with stream(device) as name:
        values = _views(args, _element_types(kernel))

        def work(_, start, count):
            wp.launch(kernel, count, [start, *values], device=name)

        if name == "cpu":
            _load(kernel)
        if name != "cpu" or serial():
            work(0, 0, n)
        else:
            over_slices(n, work, slice_min=slice_min)


class _Once(torch.autograd.Function):
    """Identity on a gradient that raises when differentiated; ``sources`` are the tensors that it depends on."""

    @staticmethod
    def forward(ctx, grad: Tensor, *sources: Tensor) -> Tensor:
        return grad.view_as(grad)

    @staticmethod
    def backward(ctx, *_):
        raise RuntimeError("second derivatives are not supported")


def once_differentiable(backward):
    """Decorator of a ``backward`` that is not differentiable: second derivatives raise RuntimeError.

    Torch's own decorator raises only if the incoming gradient requires one; for a loss that is linear in the result it
    would silently omit the inputs' part of the second derivative.  Tensors saved for backward must be the inputs
    themselves, made contiguous before ``apply``, where autograd records it.
    """

    def wrapper(ctx, *g_outs):
        with torch.no_grad():
            grads = full_precision(backward)(ctx, *g_outs)
        if not torch.is_grad_enabled():
            return grads
        several = isinstance(grads, tuple)
        sources = [t for t in (*ctx.saved_tensors, *g_outs) if t is not None and t.requires_grad]
        held = [g if g is None or not sources else _Once.apply(g, *sources) for g in (grads if several else (grads,))]
        return tuple(held) if several else held[0]

    return wrapper


class _KernelOp(torch.autograd.Function):
    """``outs = kernel(start, *ins)``; backward launches the adjoint of the same kernel."""

    @staticmethod
    def forward(ctx, kernel, n, slice_min, ins, shared, shapes, *tensors):
        types, device = _element_types(kernel), tensors[0].device
        results = [empty(shape, dtype, device) for shape, dtype in zip(shapes, types[len(ins) :], strict=True)]
        launch(kernel, n, [*_filled(ins, tensors), *results], device, slice_min=slice_min)
        ctx.save_for_backward(*tensors, *results)
        ctx.op = kernel, n, slice_min, ins, shared
        ctx.mark_non_differentiable(*(r for r in results if not r.is_floating_point()))
        return tuple(results)

    @staticmethod
    @once_differentiable
    def backward(ctx, *g_outs):
        kernel, n, slice_min, ins, shared = ctx.op
        slots = [i for i, value in enumerate(ins) if value is _SLOT]
        tensors, results = ctx.saved_tensors[: len(slots)], ctx.saved_tensors[len(slots) :]
        types, device, needed = _element_types(kernel), tensors[0].device, ctx.needs_input_grad[6:]
        largest = max((t.numel() for i, t in enumerate(tensors) if i in shared and needed[i]), default=0)
        slice_min = slice_of_accumulators(n, slice_min, largest)
        parts = slices(n, slice_min) if device.type == "cpu" else [(0, n)]
        grads = [
            torch.zeros((len(parts) if i in shared else 1, *t.shape), dtype=t.dtype, device=device) if w else None
            for i, (t, w) in enumerate(zip(tensors, needed, strict=True))
        ]
        g_results = [
            g.contiguous() if g is not None else torch.zeros_like(r) if r.is_floating_point() else None
            for g, r in zip(g_outs, results, strict=True)
        ]
        if n > 0:
            with stream(device) as name:
                values = _filled(ins, tensors)
                _check_device([*values, *g_results], device)
                values, out_values = _views(values, types[: len(ins)]), _views(results, types[len(ins) :])
                adj_out = _views(g_results, types[len(ins) :])

                def adjoint(k, start, count):
                    adj_in: list = [None] * (1 + len(ins))
                    for i, g in zip(slots, grads, strict=True):
                        adj_in[1 + i] = None if g is None else view(g[min(k, g.shape[0] - 1)], types[i])
                    wp.launch(kernel, count, [start, *values], out_values, adj_inputs=adj_in,
                              adj_outputs=adj_out, adjoint=True, device=name)  # fmt: skip

                if name == "cpu":
                    _load(kernel)
                    over_slices(n, adjoint, slice_min=slice_min)
                else:
                    adjoint(0, 0, n)
        return *[None] * 6, *(None if g is None else g.sum(0) for g in grads)


_SLOT = object()  # placeholder of a tensor among the arguments


def _filled(ins: Sequence, tensors: Sequence[Tensor]) -> list:
    rest = iter(tensors)
    return [next(rest) if value is _SLOT else value for value in ins]


def call(
    kernel, n: int, ins: Sequence, shapes: Sequence[tuple[int, ...]], *, shared: Sequence[int] = (),
    slice_min: int = SLICE_MIN,
):  # fmt: skip
    """Differentiable launch: new tensors from ``kernel(start, *ins, *outs)``, with arrays of these ``shapes`` as outs.

    ins: tensors on one device, at least one, or plain values.  Gradients reach every floating-point tensor of ``ins``
    that requires one, by the kernel's adjoint (its module needs ``enable_backward``).  shared: indices, among the
    tensors of ``ins``, of those that more than one thread reads.  slice_min: as for :func:`launch`.
    """
    tensors = [a.contiguous() for a in ins if isinstance(a, Tensor)]
    plain = [_SLOT if isinstance(a, Tensor) else a for a in ins]
    return _KernelOp.apply(kernel, n, slice_min, plain, frozenset(shared), shapes, *tensors)


def tensor_of(value, dtype: torch.dtype = torch.float32):
    """``value`` as a tensor of ``dtype`` if that is lossless: numpy arrays, and for int32 and int64 any integers.
    Other values are returned unchanged, for :func:`check` to reject."""
    if isinstance(value, np.ndarray):
        if value.dtype.name not in ("float32", "float64", "int64", "int32", "int16", "uint8", "uint16", "uint32"):
            return value
        value = value.astype(np.int64) if value.dtype.name in ("uint16", "uint32") else value
        value = torch.from_numpy(np.ascontiguousarray(value) if value.flags.writeable else value.copy())
    whole = (torch.int64, torch.int32, torch.int16, torch.uint8)
    if isinstance(value, Tensor) and dtype in whole[:2] and value.dtype in whole and value.dtype != dtype:
        limits = torch.iinfo(dtype)
        low, high = (int(v) for v in torch.aminmax(value)) if value.numel() else (0, 0)
        return value.to(dtype) if limits.min <= low and high <= limits.max else value
    return value


def mapped(value: Any, change: Callable[[Tensor], Tensor]) -> Any:
    """``value`` with ``change`` applied to its tensors, inside tuples and dataclasses too.

    A dataclass in which nothing changes is returned itself, with what it caches.
    """
    if isinstance(value, Tensor):
        return change(value)
    if isinstance(value, tuple):
        return tuple(mapped(v, change) for v in value)
    if not is_dataclass(value) or isinstance(value, type):
        return value
    old = {f.name: getattr(value, f.name) for f in fields(value)}
    new = {name: mapped(v, change) for name, v in old.items()}
    return value if all(new[name] is v for name, v in old.items()) else replace(value, **new)


class Movable:
    """Base class of frozen dataclasses of tensors."""

    def to(self: T, device: torch.device | str) -> T:
        """The same values on ``device``; ``self`` if all are there already."""
        return mapped(self, lambda tensor: tensor.to(device))

    def detach(self: T) -> T:
        """The same values without gradient."""
        return mapped(self, lambda tensor: tensor.detach())


def present(name: str, value: T | None) -> T:
    """``value``.  Raises ValueError if it is None."""
    if value is None:
        raise ValueError(f"{name}: expected a value, got None")
    return value


def expect(name: str, value: object, kind: type) -> None:
    """Raises TypeError, ``name: expected X, got Y``, unless ``value`` is a ``kind``."""
    if not isinstance(value, kind):
        raise TypeError(f"{name}: expected {kind.__name__}, got {type(value).__name__}")


def check(
    name: str,
    value: object,
    *,
    last: int | None = None,
    shape: Sequence[int | str] | None = None,
    like: Tensor | None = None,
    dtype: torch.dtype = torch.float32,
) -> None:
    """Raises TypeError or ValueError, ``name: expected X, got Y``, for a wrong type, dtype, shape or device.

    last: length of the last axis.  shape: of all axes; a letter stands for any length.
    """
    if not isinstance(value, Tensor):
        raise TypeError(f"{name}: expected a tensor, got {type(value).__name__}")
    if value.dtype != dtype:
        remedy = "; round it to float32" if (dtype, value.dtype) == (torch.float32, torch.float64) else ""
        raise TypeError(f"{name}: expected {dtype}, got {value.dtype}{remedy}")
    if last is not None and (value.ndim == 0 or value.shape[-1] != last):
        raise ValueError(f"{name}: expected shape (..., {last}), got {tuple(value.shape)}")
    if shape is not None:
        pairs = zip(value.shape, shape, strict=False)
        if value.ndim != len(shape) or any(n != k for n, k in pairs if not isinstance(k, str)):
            axes = ", ".join(map(str, shape)) + "," * (len(shape) == 1)
            raise ValueError(f"{name}: expected shape ({axes}), got {tuple(value.shape)}")
    if like is not None and value.device != like.device:
        raise ValueError(f"{name}: expected device {like.device}, got {value.device}")
