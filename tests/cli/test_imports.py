"""Imports of ``reli3d-infer``: a thread loads torch's library beside Warp's kernels, and says nothing if it cannot."""

import importlib.machinery
import os
import subprocess
import sys

import pytest

from reli3d.cli import imports
from tests.support.checkout import ROOT

BESIDE = """
import sys, threading
from reli3d.cli import imports

def mapped():
    return {line.split()[-1] for line in open("/proc/self/maps") if "libtorch_cpu.so" in line}

imports.beside_torch(["noise", "distance"])
import warp as wp
print("torch" in sys.modules, 1 in wp.get_module("reli3d.kernels.noise").hashers)
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


def test_a_process_that_has_torch_starts_no_thread(monkeypatch):
    monkeypatch.setattr(imports.threading, "Thread", lambda **_: pytest.fail("a thread"))
    imports.beside_torch(["noise"])


@pytest.mark.skipif(sys.platform != "linux", reason="Linux alone loads the library beside")
def test_a_library_that_cannot_be_loaded_is_left_to_the_import(tmp_path):
    (tmp_path / "torch" / "lib").mkdir(parents=True)
    (tmp_path / "torch" / "__init__.py").write_text("raise ImportError('says why')")
    (tmp_path / "torch" / "lib" / "libtorch_cpu.so").write_text("no library")
    env = os.environ | {"PYTHONPATH": f"{tmp_path}{os.pathsep}{ROOT}"}
    code = "from reli3d.cli import imports; imports.beside_torch(['noise']); import torch"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120, env=env)
    assert done.returncode == 1 and done.stderr.splitlines()[-1] == "ImportError: says why"
    assert done.stderr.count("Traceback") == 1  # none of a thread


@pytest.mark.parametrize("folders", [None, [], ["/nowhere"]])
def test_a_torch_without_that_library_is_left_to_its_import(monkeypatch, folders):
    monkeypatch.setattr(imports.threading, "Thread", lambda **_: pytest.fail("a thread"))
    monkeypatch.delitem(sys.modules, "torch")
    spec = importlib.machinery.ModuleSpec("torch", None)
    spec.submodule_search_locations = folders
    for found in (spec, None):
        monkeypatch.setattr(imports.importlib.util, "find_spec", lambda _, found=found: found)
        imports.beside_torch(["noise"])
