"""``reli3d doctor``: reports versions, devices, kernel cache and weights, and whether the package is usable."""

import hashlib
import json
import os
import platform
import re
import tempfile
import time
from collections.abc import Iterator
from importlib import metadata
from pathlib import Path

import reli3d
from reli3d.cli.exit_codes import Parser, command

ASSETS = Path(reli3d.__file__).parent / "assets"
PROBLEM = "PROBLEM: "  # prefix of a value that makes the package unusable


def examine() -> tuple[list[tuple[str, str]], bool]:
    """Rows ``(name, value)``, and whether the package is usable: no value begins with PROBLEM.  Compiles a kernel."""
    rows = []
    for part in (_versions, _devices, _cache, _kernels, _files):
        try:
            rows += list(part())
        except Exception as error:  # reported as a row; the other parts still run
            rows.append((part.__name__[1:], f"{PROBLEM}{type(error).__name__}: {error}"))
    problems = sum(value.startswith(PROBLEM) for _, value in rows)
    verdict = "usable" if problems == 0 else f"not usable: {problems} problem{'s' if problems > 1 else ''}"
    return [*rows, ("verdict", verdict)], problems == 0


def _versions() -> Iterator[tuple[str, str]]:
    yield "reli3d", f"{reli3d.__version__} in {Path(reli3d.__file__).parent}"
    yield "python", f"{platform.python_version()} on {platform.platform()}"
    try:
        required = [line for line in metadata.requires("reli3d") or [] if "extra ==" not in line]
    except metadata.PackageNotFoundError:
        yield "dependencies", "unknown: reli3d is not installed"
        return
    for package in (re.split(r"[^\w-]", line)[0] for line in required):
        try:
            yield package, metadata.version(package)
        except metadata.PackageNotFoundError:
            yield package, f"{PROBLEM}not installed: pip install {package}"


def _devices() -> Iterator[tuple[str, str]]:
    import torch
    import warp as wp

    from reli3d.kernels import cache

    cache.initialize()
    yield "cpu", f"{os.cpu_count()} cores, {torch.get_num_threads()} threads of torch"
    if not wp.is_cuda_available():
        yield "driver", "no NVIDIA driver or device found: runs on the CPU, which is not an error"
    if torch.version.cuda is None:
        yield "cuda", "none: this torch is built without CUDA"
    elif not torch.cuda.is_available():
        yield "cuda", f"none: torch is built for CUDA {torch.version.cuda} but finds no usable driver and device"
    else:
        for k in range(torch.cuda.device_count()):
            p = torch.cuda.get_device_properties(k)
            yield f"cuda:{k}", f"{p.name}, {p.total_memory / 2**30:.0f} GiB, compute {p.major}.{p.minor}"


def _cache() -> Iterator[tuple[str, str]]:
    import warp as wp

    from reli3d.kernels import cache

    cache.initialize()
    folder = Path(str(wp.config.kernel_cache_dir))
    try:
        with tempfile.TemporaryFile(dir=folder):
            compiled = sum(entry.is_dir() for entry in folder.iterdir())
        yield "kernel cache", f"{folder}, writable, {compiled} modules compiled"
    except OSError as error:
        yield "kernel cache", f"{PROBLEM}{folder} cannot be written ({error}); set WARP_CACHE_PATH to a folder that can"


def _kernels() -> Iterator[tuple[str, str]]:
    import torch

    from reli3d.geometry.triplane import sample_triplane

    for device in ["cpu"] + (["cuda"] if torch.cuda.is_available() else []):
        options: dict = {"device": device, "dtype": torch.float32}
        start = time.perf_counter()
        value = sample_triplane(torch.ones(1, 3, 2, 4, 4, **options), torch.zeros(1, 5, 3, **options))
        seconds = time.perf_counter() - start
        right = bool((value == 1).all())
        yield f"kernels, {device}", f"run ({seconds:.1f} s)" if right else f"{PROBLEM}a triplane of ones is not 1"


def _files() -> Iterator[tuple[str, str]]:
    weights, example = ASSETS / "weights" / "small.safetensors", ASSETS / "example"
    missing = PROBLEM + "{} is missing: install the package again"
    value = missing.format(weights)
    if weights.is_file():
        data = weights.read_bytes()
        value = f"{weights}, {len(data) / 2**20:.1f} MiB, sha256 {hashlib.sha256(data).hexdigest()}"
    yield "weights, small", value
    yield "example", str(example) if (example / "transforms.json").is_file() else missing.format(example)


@command("reli3d doctor")
def main(argv: list[str] | None = None) -> int:
    """The command ``reli3d doctor``.  Exit code: 0 usable, 1 not usable, 2 wrong arguments."""
    parser = Parser(
        prog="reli3d doctor",
        description="Print versions, devices, kernel cache and weights, and whether the package works.",
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object with the rows by name and usable")
    args = parser.parse_args(argv)
    rows, usable = examine()
    print(json.dumps({**dict(rows), "usable": usable}) if args.json else "\n".join(f"{n:16s} {v}" for n, v in rows))
    return 0 if usable else 1
