"""A broken file in the kernel cache is recompiled, as a missing one is, and reported in one line."""

import os
import subprocess
import sys

import pytest

LAUNCH = """
import torch
from reli3d import _bridge
from reli3d.kernels import {name}
if {ready}:
    _bridge.load_modules([{name}], torch.device("cpu"))
import reli3d.geometry.distance as d
box = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
print(float(d.signed_distance(box, torch.tensor([[0, 1, 2]], dtype=torch.int32), torch.tensor([[0.0, 0, 2]])).abs()))
"""


def launch(cache, ready):
    code = LAUNCH.format(name="distance", ready=ready)
    environment = {**os.environ, "WARP_CACHE_PATH": str(cache)}
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment)


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    folder = tmp_path_factory.mktemp("cache")
    done = launch(folder, True)
    assert done.returncode == 0, done.stderr
    return folder


@pytest.mark.parametrize("kind, ready", [("cut", True), ("random", False), ("meta", True)])
def test_a_broken_file_is_compiled_again(cache, kind, ready):
    objects = [p for p in cache.rglob("*.meta" if kind == "meta" else "*.o") if "distance" in str(p)]
    assert objects
    for path in objects:
        data = path.read_bytes()
        path.write_bytes({"cut": data[: len(data) // 2], "random": b"\x93\x17" * 500, "meta": b"{"}[kind])
    done = launch(cache, ready)
    assert done.returncode == 0, done.stderr
    assert float(done.stdout) == 2.0
    assert done.stderr.count("compiling it again") == 1 and "Traceback" not in done.stderr
    again = launch(cache, ready)
    assert (again.returncode, "compiling it again" in again.stderr) == (0, False)
