"""``reli3d-data render`` in several processes and on Ray: who is killed loses nothing, and the bits are the same."""

import contextlib
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from reli3d.cli import data, objects
from reli3d.render.latlong import lat_long_directions
from tests.support.checkout import ROOT
from tests.support.stages import write_maps

COUNT = 4
SLOW = pytest.mark.slow  # a cluster of Ray takes half a minute to start
PLACES = [pytest.param(["--workers", "2"], id="processes"), pytest.param(["--ray", "local"], id="ray", marks=SLOW)]


@pytest.fixture(scope="module")
def maps(tmp_path_factory):
    sky = 0.2 + 3.0 * lat_long_directions(16)[..., :1].clamp(min=0).expand(-1, -1, 3).numpy()
    return write_maps(tmp_path_factory.mktemp("maps"), np.stack([sky * (1 + 0.2 * k) for k in range(6)]))


def call(maps: Path, out: Path, *options: str) -> list[str]:
    return ["render", str(out), "--maps", str(maps), "--count", str(COUNT), "--size", "64", "--views", "4", *options]


@pytest.fixture(scope="module")
def alone(maps, tmp_path_factory):
    """The bytes of the samples of one process, by name."""
    out = tmp_path_factory.mktemp("alone")
    assert data.main(call(maps, out, "--workers", "1")) == 0
    return {p.name: p.read_bytes() for p in out.iterdir()}


def at_work(of: int) -> list[int]:
    """Processes below ``of`` that make samples."""
    found: list[int] = []
    with contextlib.suppress(OSError):  # it has ended
        for path in Path(f"/proc/{of}/task").glob("*/children"):
            for pid in map(int, path.read_text().split()):
                line = Path(f"/proc/{pid}/cmdline").read_bytes()
                found += [pid] * (b"ray::_made" in line or b"spawn_main" in line)  # Ray writes a worker's task there
                found += at_work(pid)
    return found


@pytest.mark.skipif(not Path("/proc").is_dir(), reason="finds the processes in /proc")
@pytest.mark.parametrize("where", PLACES)
def test_the_work_of_a_killed_process_is_done_again(where, maps, alone, tmp_path):
    if "--ray" in where:
        pytest.importorskip("ray")
    out = tmp_path / "out"
    command = [sys.executable, "-m", "reli3d.cli.data", *call(maps, out, *where)]
    with subprocess.Popen(command, cwd=ROOT, stderr=subprocess.PIPE, text=True) as process:
        until, killed = time.monotonic() + 200, None
        while process.poll() is None and killed is None and time.monotonic() < until:
            if out.is_dir() and any(out.glob("*.safetensors")) and (found := at_work(process.pid)):
                killed = found[0]
                os.kill(killed, signal.SIGKILL)
            time.sleep(0.02)
        _, output = process.communicate(timeout=300)
    assert killed and process.returncode == 0, output
    assert {p.name: p.read_bytes() for p in out.glob("*.safetensors")} == alone


def test_what_cannot_be_made_is_reported_and_the_rest_is_made(maps, tmp_path, monkeypatch, capsys):
    """A refused object and a worker that crashed twice cost only their own sample; a full disk ends the command."""
    ends = [
        objects.Row("0000000000", "refused", notes=("mesh: expected a surface, got none",)),
        objects.Row("0000000001", "failed", notes=(objects.CRASHED,)),
        objects.Row("0000000002", "done"),
    ]
    monkeypatch.setattr(objects, "in_processes", lambda *_: (row for row in ends))
    assert data.main(call(maps, tmp_path)) == 1
    output = capsys.readouterr().err
    assert "0000000000: mesh: expected a surface" in output and "0000000001: its worker crashed twice" in output
    ends.append(objects.Row("0000000003", "failed", notes=("no space left",)))
    assert data.main(call(maps, tmp_path)) == 1
    assert "0000000003: no space left" in capsys.readouterr().err


def test_ray_that_is_missing_is_reported_in_one_line(maps, tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "ray", None)  # its import raises
    assert data.main(call(maps, tmp_path / "out", "--ray", "local")) == 2
    assert "pip install reli3d[ray]" in capsys.readouterr().err
