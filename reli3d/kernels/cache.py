"""Warp at its start, and the folder that holds compiled kernels."""

import os
import shutil
import sys
import tempfile
import threading
from collections.abc import Sequence
from functools import lru_cache
from types import ModuleType

import warp as wp

CPU_BLOCK = 1  # block size of Warp's CPU launches; loading a module for its default one would compile it once more
EMBREE = ("embree", "shade_rays")  # modules whose kernels call Embree, which runs on a CPU alone
LOADING = threading.Lock()  # Warp has none: it would be started, and a module compiled, by two threads at once


def initialize() -> None:
    """Start Warp once: quiet on stdout, and with a kernel cache that can be written."""
    with LOADING:
        _start()


@lru_cache(1)
def _start() -> None:
    wp.config.log_level = wp.LOG_WARNING
    try:
        wp.init()
        writable = os.access(str(wp.config.kernel_cache_dir), os.W_OK)
    except OSError:
        writable = False
    if not writable:
        fallback = private_folder()
        print(f"reli3d: kernel cache {wp.config.kernel_cache_dir} cannot be written; using {fallback}", file=sys.stderr)
        wp.config.kernel_cache_dir = fallback
        wp.init()


def imported(kind: str) -> list[ModuleType]:
    """The modules of :mod:`reli3d.kernels` with kernels for ``cpu`` or ``cuda`` that this process has imported."""
    found = [m for name, m in sorted(sys.modules.items()) if name.startswith("reli3d.kernels.")]
    found = [m for m in found if kind == "cpu" or m.__name__.rpartition(".")[2] not in EMBREE]
    return [m for m in found if any(isinstance(value, wp.Kernel) for value in vars(m).values())]


def compiled(modules: Sequence[ModuleType], kind: str) -> bool:
    """Whether the kernel cache has all of these kernel modules for ``cpu`` or ``cuda``: loading them takes no time."""
    initialize()
    block = CPU_BLOCK if kind == "cpu" else None
    names = [wp.get_module(m.__name__).get_module_identifier(block_dim=block) for m in modules]
    return all(os.path.isdir(os.path.join(str(wp.config.kernel_cache_dir), name)) for name in names)


def private_folder() -> str:
    """Folder for compiled kernels that no other user can have filled: the same one in the next process."""
    user = os.getuid() if hasattr(os, "getuid") else 0
    folder = os.path.join(tempfile.gettempdir(), f"reli3d-warp-{user}")
    os.makedirs(folder, mode=0o700, exist_ok=True)
    return folder if os.name == "nt" or os.lstat(folder).st_uid == user else tempfile.mkdtemp(prefix="reli3d-warp-")


def repaired(module, block: int | None, load) -> None:
    """``load()``; where it fails, once more without the module's folder in the kernel cache, which may be broken."""
    try:
        load()
    except Exception as error:  # Warp raises no narrower class
        folder = os.path.join(wp.config.kernel_cache_dir, module.get_module_identifier(block_dim=block))
        print(f"reli3d: {folder} cannot be loaded ({error}); compiling it again", file=sys.stderr)
        shutil.rmtree(folder, ignore_errors=True)
        module.mark_modified()
        load()
