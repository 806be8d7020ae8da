"""Warp at its start, and the folder that holds compiled kernels."""

import contextlib
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
LOADING = threading.Lock()  # Warp has none: it would be started, and a module compiled, by two threads at once


def initialise() -> None:
    """Start Warp once: quiet on stdout, and with a kernel cache that can be written."""
    with LOADING:
        _start()


@lru_cache(1)
def _start() -> None:
    wp.config.log_level = wp.LOG_WARNING
    try:
        with no_driver_warning():
            wp.init()
        writable = os.access(str(wp.config.kernel_cache_dir), os.W_OK)
    except OSError:
        writable = False
    if not writable:
        fallback = private_folder()
        print(f"reli3d: kernel cache {wp.config.kernel_cache_dir} cannot be written; using {fallback}", file=sys.stderr)
        wp.config.kernel_cache_dir = fallback
        with no_driver_warning():
            wp.init()


def compiled(modules: Sequence[ModuleType], kind: str) -> bool:
    """Whether the kernel cache has all of these kernel modules for ``cpu`` or ``cuda``: loading them takes no time."""
    initialise()
    block = CPU_BLOCK if kind == "cpu" else None
    names = [wp.get_module(m.__name__).get_module_identifier(block_dim=block) for m in modules]
    return all(os.path.isdir(os.path.join(str(wp.config.kernel_cache_dir), name)) for name in names)


@contextlib.contextmanager
def no_driver_warning():
    """Keeps a line of Warp's native code from the terminal: that there is no NVIDIA driver.

    Without one that is no news (``reli3d doctor`` says it), and it is written past Python to file descriptor 2.  What
    else is written there meanwhile is passed on.
    """
    try:
        terminal = os.dup(2)
    except OSError:  # a process without that stream
        yield
        return
    with tempfile.TemporaryFile() as caught:
        os.dup2(caught.fileno(), 2)
        try:
            yield
        finally:
            os.dup2(terminal, 2)
            os.close(terminal)
            caught.seek(0)
            rest = b"".join(line for line in caught if b"Could not find or load the NVIDIA CUDA driver" not in line)
            if rest:
                os.write(2, rest)


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
