"""A kernel cache that cannot be written is replaced; a broken file in it is recompiled and reported in one line."""

import os
import subprocess
import sys

KERNEL = """
import warp as wp

wp.set_module_options({{"enable_backward": False}})

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
import broken_cut, broken_meta
_bridge.load_modules([broken_meta], torch.device("cpu"))
for module in (broken_cut, broken_meta):
    x, y = torch.ones(5), torch.zeros(5)
    _bridge.launch(module.triple_kernel, 5, [x, y], x.device)
    print(float(y.sum()))
"""


def test_an_unwritable_cache_has_a_replacement_and_broken_files_are_compiled_again(tmp_path):
    """One module is loaded ahead, the other at its first launch."""
    kinds = ("cut", "meta")
    for number, kind in enumerate(kinds):
        (tmp_path / f"broken_{kind}.py").write_text(KERNEL.format(number=number))
    (tmp_path / "file").write_text("a file where the folder should be")
    environment = {**os.environ, "WARP_CACHE_PATH": str(tmp_path / "file"), "TMPDIR": str(tmp_path)}

    def launched() -> str:
        command = [sys.executable, "-c", LAUNCH, str(tmp_path)]
        done = subprocess.run(command, capture_output=True, text=True, env=environment)
        assert done.returncode == 0, done.stderr
        assert [float(line) for line in done.stdout.split()] == [15.0, 20.0]
        return done.stderr

    output = launched()
    assert "compiling it again" not in output and output.count("cannot be written; using") == 1
    (folder,) = tmp_path.glob("reli3d-warp-*")
    for kind in kinds:
        (path,) = folder.rglob(f"*broken_{kind}*.meta" if kind == "meta" else f"*broken_{kind}*.o")
        data = path.read_bytes()
        path.write_bytes(b"{" if kind == "meta" else data[: len(data) // 2])
    output = launched()
    lines = [line for line in output.splitlines() if "compiling it again" in line]
    assert len(lines) == 2 and "Traceback" not in output
    assert all(sum(f"broken_{kind}" in line for line in lines) == 1 for kind in kinds)
    assert "compiling it again" not in launched()
