"""The processes of the installed commands: their exit codes, and what is still done before they end."""

import importlib
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from reli3d.cli import program
from tests.support.checkout import ROOT

# A module stands in for a command; what it leaves to the end of the process must be done, and nothing after that.
PROGRAM = """
import sys, types
from reli3d.cli import program
command = types.ModuleType("reli3d.cli.stand_in")
exec(sys.argv.pop(1), vars(command))
sys.modules[command.__name__] = command
program.run("stand_in")
"""


UNSET = ("PYTHONUNBUFFERED", "GOMP_SPINCOUNT", "OMP_WAIT_POLICY")  # the first: nothing would be left to be flushed


def ran(text: str, *options: str, more: dict[str, str] | None = None, **streams) -> subprocess.CompletedProcess:
    """more: of the environment, which says nothing about threads else."""
    streams = streams or {"capture_output": True}
    env = {k: v for k, v in os.environ.items() if k not in UNSET} | (more or {})
    return subprocess.run([sys.executable, "-c", PROGRAM, text, *options], text=True, timeout=60, env=env, **streams)


@pytest.mark.parametrize("code", [0, 2, 130])
def test_the_exit_code_is_that_of_the_command(code):
    assert ran(f"def main(): return {code}").returncode == code


def test_what_is_buffered_registered_and_still_running_is_done_first():
    done = ran(
        """
import atexit, sys, threading, time
def late():
    time.sleep(0.3)
    print("thread")
def main():
    threading.Thread(target=late).start()
    atexit.register(print, "registered")
    sys.stderr.write("error")
    print("main")
    return 1
"""
    )
    assert done.stdout.split() == ["main", "thread", "registered"] and done.stderr == "error" and done.returncode == 1


def test_the_interpreter_is_not_taken_apart():
    text = """
class Last:
    def __del__(self):
        print("taken apart")
last = Last()
def main(): return 0
"""
    assert ran(text).stdout == ""
    assert ran(text.replace("return 0", "raise SystemExit(0)")).stdout == "taken apart\n"


def test_threads_wait_asleep_unless_the_environment_says_otherwise():
    text = "import os\ndef main(): print(os.environ.get('GOMP_SPINCOUNT')); return 0"
    assert ran(text).stdout.strip() == program.SPINS
    assert ran(text, more={"GOMP_SPINCOUNT": "7"}).stdout.strip() == "7"
    assert ran(text, more={"OMP_WAIT_POLICY": "active"}).stdout.strip() == "None"


def test_help_and_errors_end_as_ever():
    asked = ran("import argparse\ndef main(): argparse.ArgumentParser(prog='x').parse_args()", "--help")
    assert asked.returncode == 0 and asked.stdout.startswith("usage: x")
    wrong = ran("def main(): raise RuntimeError('broken')")
    assert wrong.returncode == 1 and "RuntimeError: broken" in wrong.stderr


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs a device that is full")
def test_a_result_that_cannot_be_written_is_no_success():
    with open("/dev/full", "w") as full:
        assert ran("def main(): print('x'); return 0", stdout=full, stderr=subprocess.DEVNULL).returncode == 120


def test_each_installed_command_runs_a_module_that_has_a_main():
    text = (ROOT / "pyproject.toml").read_text()
    scripts = re.findall(r'^(reli3d[a-z-]*) = "(.*):(.*)"$', text, re.MULTILINE)
    assert len(scripts) >= 8
    for name, module, function in scripts:
        assert module == program.__name__
        (command,) = getattr(program, function).args
        assert command == (name.partition("-")[2] or "main")
        assert callable(importlib.import_module(f"reli3d.cli.{command}").main)
