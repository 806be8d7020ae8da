"""How the commands end where the machine, the streams or the user are the problem: one line and the right exit code."""

import os
import re
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor

import pytest

from reli3d.cli import infer, render
from tests.support.processes import heed_signals

# reli3d-infer without torch, which takes seconds to load, and without a network: its one object is {body}
QUICK = """
import atexit, sys, threading, time, types
from reli3d.cli import infer
from reli3d.output.folder import claimed
class Job:
    def __init__(self, args, device, budget):
        pass
    def run(self, folder, name, target):
        with claimed(target, ["mesh.glb"]) as replacing:
            {body}
        return "done"
sys.modules["reli3d.cli.job"] = types.SimpleNamespace(FolderJob=Job, worker=Job)
infer.choose_device = lambda device: device
sys.exit(infer.main())
"""
WRITES = """with replacing() as new:
                (new / "mesh.glb").write_text("mesh")"""
WAITS = """with replacing() as new:
                (new / "mesh.glb").write_text("mesh")
                print("working", flush=True)
                time.sleep(60)"""
ENDS_LATE = f"""{WRITES}
            threading.Thread(target=time.sleep, args=(0.4,)).start()
            atexit.register(time.sleep, 0.4)"""


def start(arguments, *, body=WRITES, **options) -> subprocess.Popen:
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    options = {**pipes, "preexec_fn": heed_signals, **options}
    return subprocess.Popen([sys.executable, "-c", QUICK.format(body=body), *map(str, arguments)], **options)


def lines_of(text: str) -> list[str]:
    """The command's own lines; the bar is redrawn with carriage returns."""
    return [line for line in re.split("[\r\n]", text) if line.startswith("reli3d-infer: ")]


@pytest.mark.parametrize(
    "number, code, text",
    [(signal.SIGINT, 130, "interrupted"), (signal.SIGTERM, 143, "SIGTERM"), (signal.SIGHUP, 129, "SIGHUP")],
)
def test_a_signal_ends_with_one_line_and_leaves_nothing_behind(tmp_path, number, code, text):
    process = start(["--output", tmp_path / "out"], body=WAITS)
    assert process.stdout.readline() == "working\n"
    process.send_signal(number)
    out, err = process.communicate(timeout=30)
    assert process.returncode == code and out == "" and "Traceback" not in err
    assert len(lines_of(err)) == 1 and text in lines_of(err)[0]
    assert list(tmp_path.iterdir()) == []


def test_ascii_streams_change_nothing(tmp_path):
    process = start(
        ["--output", tmp_path / "größe"],
        env={**os.environ, "LC_ALL": "C", "PYTHONIOENCODING": "ascii:strict", "PYTHONOPTIMIZE": "1"},
    )
    out, err = process.communicate(timeout=60)
    assert process.returncode == 0, err
    assert out.endswith("\\xf6\\xdfe/example/mesh.glb\n") and "Traceback" not in err
    process = start(
        [tmp_path / "größer"],
        body="from reli3d.errors import InputError; raise InputError('größer', 'expected another')",
        cwd=tmp_path,
        env={**os.environ, "PYTHONIOENCODING": "ascii:strict"},
    )
    err = process.communicate(timeout=60)[1]
    assert process.returncode == 2 and lines_of(err) == ["reli3d-infer: gr\\xf6\\xdfer: expected another"]


@pytest.mark.parametrize("streams", [(1,), (2,), (0, 1, 2)])
def test_closed_streams_change_nothing(tmp_path, streams):
    with open(tmp_path / "log", "w") as log:
        options = {"stdout": log, "stderr": log, "preexec_fn": lambda: [os.close(n) for n in streams]}
        process = start(["--output", tmp_path / "out"], **options)
        assert process.wait(60) == 0
    assert (tmp_path / "out/example/mesh.glb").read_text() == "mesh"
    assert "Traceback" not in (tmp_path / "log").read_text()


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="needs /dev/full")
@pytest.mark.parametrize("name", ["stdout", "stderr"])
def test_full_streams_change_nothing(tmp_path, name):
    with open("/dev/full", "w") as full:
        process = start(["--output", tmp_path / "out"], **{name: full})
        output = process.communicate(timeout=60)
    assert process.returncode == 0, output
    assert "Exception" not in "".join(s or "" for s in output)


def test_a_reader_that_goes_away_changes_nothing(tmp_path):
    process = start(["--output", tmp_path / "out"])
    process.stdout.close()
    err = process.stderr.read()
    assert process.wait(60) == 0 and "Broken" not in err
    process.stderr.close()


def test_a_full_disk_is_one_line_and_leaves_the_old_result(tmp_path):
    """A limit on the size of a file instead of a full disk: both raise OSError in the middle of a write."""
    (tmp_path / "out/example").mkdir(parents=True)
    (tmp_path / "out/example/mesh.glb").write_text("old")
    body = """import resource
            resource.setrlimit(resource.RLIMIT_FSIZE, (1000, 1000))
            with replacing() as new:
                (new / "mesh.glb").write_bytes(bytes(1 << 20))"""
    process = start(["--output", tmp_path / "out"], body=body)
    out, err = process.communicate(timeout=60)
    assert process.returncode == 1 and out == ""
    assert len(lines_of(err)) == 1 and "File too large" in lines_of(err)[0] and "Traceback" not in err
    assert (tmp_path / "out/example/mesh.glb").read_text() == "old"
    assert {p.name for p in (tmp_path / "out").iterdir()} <= {"example", "example.reli3d.log"}


@pytest.mark.skipif(os.name == "nt", reason="needs signals")
@pytest.mark.parametrize("number, code", [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_signal_while_the_interpreter_ends_is_one_line_too(tmp_path, number, code):
    """After the path is printed the process waits for a thread, then for functions registered at exit."""

    def end(k):
        process = start(["--output", tmp_path / f"out{k}"], body=ENDS_LATE)
        assert process.stdout.readline().endswith("mesh.glb\n")
        time.sleep(0.15 * k)
        (sent := tmp_path / f"sent{k}").touch()  # the line may be read late; the mesh was written before it
        written, sent = (p.stat().st_mtime for p in (tmp_path / f"out{k}/example/mesh.glb", sent))
        early = sent - written < 0.4  # of 0.8
        process.send_signal(number)
        _, err = process.communicate(timeout=30)
        found = (process.returncode, len(lines_of(err)))
        assert found == (code, 1) or (not early and found == (0, 0)), (k, found, err)
        assert "Traceback" not in err and "Exception" not in err
        assert (tmp_path / f"out{k}/example/mesh.glb").read_text() == "mesh"
        return process.returncode

    with ThreadPoolExecutor(6) as pool:
        assert code in list(pool.map(end, range(6)))


@pytest.mark.parametrize("fails, code", [("", 0), ("; 1 / 0", 1)])
def test_the_process_ends_before_python_frees_objects_and_ignores_signals(tmp_path, fails, code):
    """Objects of torch take 1.6 s, in which no handler runs; here one takes a minute."""
    kept = f"""atexit.register(print, "at exit")
            sys.kept = type("Kept", (), {{"__del__": lambda self, sleep=time.sleep: sleep(60)}})(){fails}"""
    process = start(["--output", tmp_path / "out"], body=f"{WRITES}\n            {kept}")
    out, err = process.communicate(timeout=40)
    assert process.returncode == code and out.endswith("at exit\n") and len(lines_of(err)) == code


def test_an_internal_error_is_one_line_exit_code_1_and_a_log(tmp_path):
    for error, options, traces in (("ImportError", [], 0), ("OSError", ["--traceback"], 1)):
        process = start(["--output", tmp_path / "out", *options], body=f"raise {error}('spoon')")
        out, err = process.communicate(timeout=60)
        assert process.returncode == 1 and out == "" and err.count("Traceback") == traces
        (line,) = lines_of(err)
        assert error in line and "spoon" in line and "example.reli3d.log" in line
        assert "Traceback" in (tmp_path / "out" / "example.reli3d.log").read_text()
    process = start(["--output", tmp_path / "out"])
    assert process.wait(60) == 0 and not (tmp_path / "out" / "example.reli3d.log").exists()
    process.communicate()


def test_a_bug_outside_of_the_objects_is_logged_next_to_the_output(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(infer, "refinement_budget", lambda *_: 1 + "a")
    assert infer.main(["--output", str(tmp_path / "out"), "--device", "cpu"]) == 1
    out, err = capsys.readouterr()
    assert out == "" and err.startswith("reli3d-infer: TypeError: ") and err.count("\n") == 1
    assert "Traceback" in (tmp_path / "out.reli3d.log").read_text()
    monkeypatch.setattr(render, "render_files", lambda *_: 1 + "a")
    assert render.main(["mesh.glb", "--output", str(tmp_path / "turn.mp4")]) == 1
    assert "Traceback" in (tmp_path / "turn.mp4.reli3d.log").read_text()
