"""Imports of ``reli3d-infer``: a thread loads torch's library beside Warp's kernels, and says nothing if it cannot."""

import importlib.machinery
import os
import subprocess
import sys

import pytest
import warp as wp

from reli3d.cli import imports
from reli3d.kernels import cache
from tests.support.checkout import ROOT

BESIDE = """
import sys, threading
from reli3d.cli import imports

def mapped():
    return {line.split()[-1] for line in open("/proc/self/maps") if "libtorch_cpu.so" in line}

imports.beside_torch(["noise", "distance"])
print("torch" in sys.modules, "reli3d.kernels.noise" in sys.modules)
for thread in threading.enumerate():
    if thread is not threading.main_thread():
        thread.join()
before = mapped()
import torch
print(len(before), before == mapped(), float(torch.arange(4.0).sum()))
"""


@pytest.mark.skipif(sys.platform != "linux", reason="Linux alone loads the library beside")
def test_the_library_is_there_before_torch_and_is_the_one_that_torch_takes():
    env = os.environ | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run([sys.executable, "-c", BESIDE], capture_output=True, text=True, timeout=120, env=env)
    assert done.returncode == 0 and done.stderr == "", done.stderr
    assert done.stdout.split() == ["False", "True", "1", "True", "6.0"]


def test_a_process_that_has_torch_starts_no_thread_and_knows_its_hashes(monkeypatch):
    monkeypatch.setattr(imports.threading, "Thread", lambda **_: pytest.fail("a thread"))
    imports.beside_torch(["noise"])
    monkeypatch.setattr(wp.Module, "hash_module", lambda *_: pytest.fail("computed once more"))
    cache.compiled(imports.kernel_modules(["noise"]), "cpu")


@pytest.mark.parametrize("folders", [None, [], ["/nowhere"]])
def test_a_torch_without_that_library_is_left_to_its_import(monkeypatch, folders):
    monkeypatch.setattr(imports.threading, "Thread", lambda **_: pytest.fail("a thread"))
    monkeypatch.delitem(sys.modules, "torch")
    spec = importlib.machinery.ModuleSpec("torch", None)
    spec.submodule_search_locations = folders
    for found in (spec, None):
        monkeypatch.setattr(imports.importlib.util, "find_spec", lambda _, found=found: found)
        imports.beside_torch(["noise"])
