"""Imports of a program that reconstructs: torch's library is loaded beside the import of Warp's kernels."""

from __future__ import annotations

import ctypes
import importlib
import importlib.util
import os
import sys
import threading
from collections.abc import Sequence


def kernel_modules(names: Sequence[str]) -> list:
    """Kernel modules of these names (:mod:`reli3d.kernels`), which import no torch."""
    return [importlib.import_module(f"reli3d.kernels.{name}") for name in names]


def beside_torch(names: Sequence[str]) -> None:
    """Import Warp, then kernel modules while a thread loads torch's library, and look them up in the kernel cache.

    Loading takes 0.15 s, in which Python's ``import`` would hold the interpreter.  Warp is imported and started
    before: its libraries and extension modules would wait for the thread, because the loader does one thing at a time.
    """
    from reli3d.kernels import cache

    cache.initialise()
    if sys.platform == "linux" and "torch" not in sys.modules:
        threading.Thread(target=_load_torch, daemon=True).start()
    cache.compiled(kernel_modules(names), "cpu")  # Warp keeps the hashes


def _load_torch() -> None:
    """Load what ``import torch`` will ask for; where that fails, the import will say why."""
    found = importlib.util.find_spec("torch")
    if found is None or not found.submodule_search_locations:
        return
    path = os.path.join(found.submodule_search_locations[0], "lib", "libtorch_cpu.so")
    dlopen = ctypes.CDLL(None).dlopen  # a function called through ctypes does not hold the interpreter, CDLL(path) does
    dlopen.argtypes, dlopen.restype = (ctypes.c_char_p, ctypes.c_int), ctypes.c_void_p
    dlopen(os.fsencode(path), os.RTLD_NOW)
