"""A broken file in the kernel cache is recompiled, as a missing one is, and reported in one line."""

import os
import subprocess
import sys

KERNEL = """
import warp as wp

@wp.kernel
def triple_kernel(start: int, x: wp.array[float], y: wp.array[float]):
    i = start + wp.tid()
    y[i] = 3.0 * x[i] + {number}.0
"""
LAUNCH = """
import sys
sys.path.insert(0, sys.argv[1])
import torch
from reli3d import _bridge
import broken_cut, broken_meta, broken_random
_bridge.load_modules([broken_cut, broken_meta], torch.device("cpu"))
for module in (broken_cut, broken_meta, broken_random):
    x, y = torch.ones(5), torch.zeros(5)
    _bridge.launch(module.triple_kernel, 5, [x, y], x.device)
    print(float(y.sum()))
"""


def test_broken_files_are_compiled_again(tmp_path):
    """Modules that are loaded ahead, and one that is loaded at its first launch."""
    kinds = ("cut", "meta", "random")
    for number, kind in enumerate(kinds):
        (tmp_path / f"broken_{kind}.py").write_text(KERNEL.format(number=number))
    environment = {**os.environ, "WARP_CACHE_PATH": str(tmp_path / "cache")}

    def launched() -> str:
        command = [sys.executable, "-c", LAUNCH, str(tmp_path)]
        done = subprocess.run(command, capture_output=True, text=True, env=environment)
        assert done.returncode == 0, done.stderr
        assert [float(line) for line in done.stdout.split()] == [15.0, 20.0, 25.0]
        return done.stderr

    assert "compiling it again" not in launched()
    for kind in kinds:
        (path,) = (tmp_path / "cache").rglob(f"*broken_{kind}*.meta" if kind == "meta" else f"*broken_{kind}*.o")
        data = path.read_bytes()
        path.write_bytes({"cut": data[: len(data) // 2], "random": b"\x93\x17" * 500, "meta": b"{"}[kind])
    output = launched()
    lines = [line for line in output.splitlines() if "compiling it again" in line]
    assert len(lines) == 3 and "Traceback" not in output
    assert all(sum(f"broken_{kind}" in line for line in lines) == 1 for kind in kinds)
    assert "compiling it again" not in launched()
