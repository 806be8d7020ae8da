"""Every kernel, forward and adjoint, under Warp's own checks: array bounds, floating point, access, overwrites."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.support.checkout import ROOT

pytestmark = pytest.mark.slow  # all kernels compile again: two minutes a mode


# each runs the table of operations, which launches every kernel but two (tests/bridge/test_ops.py)
TABLE = "tests/bridge/test_ops.py -q -x -p no:cacheprovider -k"
SELECTED = "strides or left_out"
MODES = {
    "array bounds": "wp.config.mode = 'debug'",
    "floating point": "wp.config.verify_fp = True",
    "array access": "wp.config.launch_array_access_mode = wp.config.LaunchArrayAccessMode.STRICT",
    "overwritten inputs": "wp.config.verify_autograd_array_access = True",
}
OUT_OF_BOUNDS = """
import sys
import warp as wp
{setting}

@wp.kernel
def beyond(a: wp.array[float], k: int):
    a[wp.tid()] = a[wp.tid() + k]

a = wp.zeros(4, dtype=float, device="cpu")
wp.launch(beyond, 4, [a, {step}], device="cpu")
sys.stdout.write("went on")
"""


def run(code: str, folder: Path) -> subprocess.CompletedProcess:
    env = {**os.environ, "PYTHONPATH": str(ROOT), "WARP_CACHE_PATH": str(folder / "cache")}
    path = folder / "job.py"
    path.write_text(code)  # Warp reads the source of its kernels from a file
    return subprocess.run([sys.executable, str(path)], cwd=ROOT, env=env, capture_output=True, text=True, timeout=1500)


@pytest.mark.parametrize("mode", MODES)
def test_every_kernel_runs_clean(tmp_path, mode):
    arguments = [*TABLE.split(), SELECTED]
    done = run(f"import sys, pytest\nimport warp as wp\n{MODES[mode]}\nsys.exit(pytest.main({arguments!r}))", tmp_path)
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]


def test_the_mode_with_array_bounds_ends_a_kernel_that_leaves_them(tmp_path):
    """That the run above could fail: one element beyond the end, which release mode reads."""
    setting = MODES["array bounds"]
    inside = run(OUT_OF_BOUNDS.format(setting=setting, step=0), tmp_path)
    assert inside.returncode == 0 and "went on" in inside.stdout, inside.stderr
    beyond = run(OUT_OF_BOUNDS.format(setting=setting, step=1), tmp_path)
    assert beyond.returncode != 0 and "went on" not in beyond.stdout
    assert "Assertion failed" in beyond.stdout + beyond.stderr
    release = run(OUT_OF_BOUNDS.format(setting="", step=1), tmp_path)
    assert release.returncode == 0
