"""Imports of a program that reconstructs: torch's library is loaded beside the import of Warp's kernels."""

from __future__ import annotations

import ctypes
import importlib
import importlib.util
import os
import sys
import threading
from collections.abc import Sequence
from types import ModuleType


def kernel_modules(names: Sequence[str]) -> list[ModuleType]:
    """Kernel modules of these names (:mod:`reli3d.kernels`), which import no torch."""
    return [importlib.import_module(f"reli3d.kernels.{name}") for name in names]


def beside_torch(names: Sequence[str]) -> None:
    """Import Warp, then kernel modules while a thread loads torch's library, and look them up in the kernel cache.

    Loading takes 0.15 s, in which Python's ``import`` would hold the interpreter.  Warp is imported and started
    before: its libraries and extension modules would wait for the thread, because the loader does one thing at a time.
    """
    from reli3d.kernels import cache

    cache.initialise()
    path = None if "torch" in sys.modules else _library()
    dlopen = getattr(ctypes.CDLL(None), "dlopen", None) if path else None
    if path and dlopen:  # a function that ctypes calls does not hold the interpreter; ctypes.CDLL(path) does
        dlopen.argtypes, dlopen.restype = (ctypes.c_char_p, ctypes.c_int), ctypes.c_void_p
        threading.Thread(target=dlopen, args=(os.fsencode(path), os.RTLD_NOW), daemon=True).start()
    cache.compiled(kernel_modules(names), "cpu")  # Warp keeps the hashes


def _library() -> str | None:
    """What ``import torch`` loads on Linux; None where it is not there: the import will say why."""
    found = importlib.util.find_spec("torch") if sys.platform == "linux" else None
    folders = found.submodule_search_locations if found else None
    path = os.path.join(folders[0], "lib", "libtorch_cpu.so") if folders else ""
    return path if os.path.isfile(path) else None
