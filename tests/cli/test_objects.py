"""Many objects: in one process, in several, on Ray; nothing is lost and nothing done twice where workers crash."""

import csv
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from concurrent.futures import Future
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path

import pytest

from reli3d.cli import infer, objects
from reli3d.errors import InputError
from tests.support.checkout import ROOT
from tests.support.example import QUICK
from tests.support.jobs import WordJob
from tests.support.processes import heed_signals

WORDS = ["one", "crash once", "three", "refuse", "crash", "six", "fail", "eight", "nine", "crash once"]
WITH_RAY = pytest.param("ray", marks=pytest.mark.slow)  # its cluster takes half a minute to start


def folders(root: Path, words: list[str]) -> list[objects.Item]:
    for k, word in enumerate(words):
        (root / f"object{k}").mkdir(parents=True)
        (root / f"object{k}" / "word").write_text(word)
    return objects.items_of([root / f"object{k}" for k in range(len(words))], root / "out")


def read_table(path: Path) -> list[dict[str, str]]:
    with open(path, encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def rows(where: str, start: Callable, items: list[objects.Item]):
    if where == "here":
        job = start()
        return [objects.make(job, item) for item in items]
    if where == "processes":
        return list(objects.in_processes(start, items, 2))
    pytest.importorskip("ray")
    return list(objects.on_ray(start, items, "local"))


@pytest.mark.parametrize("where", ["here", "processes", WITH_RAY])
def test_every_object_has_one_row_and_one_result(tmp_path, where):
    words = [w for w in WORDS if "crash" not in w]
    items = folders(tmp_path, words)
    found = {row.object: row for row in rows(where, WordJob(tmp_path / "log").start(), items)}
    assert list(sorted(found)) == [item.name for item in items]
    for item, word in zip(items, words, strict=True):
        row = found[item.name]
        if word in ("refuse", "fail"):
            assert row.result == {"refuse": "refused", "fail": "failed"}[word] and not item.target.exists()
            note = {"refuse": "word: expected another, got refuse", "fail": "RuntimeError: it failed"}[word]
            assert row.notes[0] == note
        else:
            assert (item.target / "mesh.glb").read_text() == word and not row.retried
            assert (row.result, row.mask_iou, row.faces) == ("done", 0.5, len(word)) and row.seconds >= 0
    assert sorted((tmp_path / "log").read_text().split()) == sorted(i.name for i in items if i.target.exists())
    again = rows("here", WordJob(tmp_path / "log").start(), items)
    assert [r.result for r in again].count("skipped") == len(words) - 2
    assert all(r.faces and r.seconds is None for r in again if r.result == "skipped")


@pytest.mark.skipif(os.name == "nt", reason="needs SIGKILL")
@pytest.mark.parametrize("where", ["processes", WITH_RAY])
def test_a_worker_that_crashes_loses_nothing_and_its_object_is_made_once_more(tmp_path, capsys, where):
    items = folders(tmp_path, WORDS)
    found = rows(where, WordJob(tmp_path / "log").start(), items)
    assert sorted(row.object for row in found) == [item.name for item in items]  # one row each
    retried = {row.object for row in found if row.retried}
    assert retried >= {item.name for item, word in zip(items, WORDS, strict=True) if "crash" in word}
    output = capsys.readouterr().err.splitlines()
    assert sorted(output) == sorted(f"{name}: its worker crashed; retrying" for name in retried)
    result = {row.object: row.result for row in found}
    finished = sorted((tmp_path / "log").read_text().split())
    for item, word in zip(items, WORDS, strict=True):
        expected = {"refuse": "refused", "fail": "failed", "crash": "failed"}.get(word, "done")
        assert result[item.name] == expected, (word, found)
        assert (expected == "done") == item.target.exists()
        assert (item.name in finished) == (expected == "done") or item.name in retried  # its last line may be missing
    assert "crashed twice" in " ".join(next(r.notes for r in found if r.object == "object4"))
    # the dead left their half-written folders, which the next claim of the same object removes; nothing else is there
    left = {p.name for p in (tmp_path / "out").iterdir()} - {i.name for i in items}
    assert left == {".object4.partial", "object6.reli3d.log"}  # of the word fail


def test_an_object_that_a_broken_pool_never_ends_is_made_again(tmp_path):
    """Such as one submitted while the pool broke, in Python 3.11; those of the next pool go on."""
    items, submitted = folders(tmp_path, ["one", "two"]), []

    def submit(item):
        future = Future()
        submitted.append(item.name)
        if len(submitted) == 2:
            future.set_exception(BrokenProcessPool())
        elif len(submitted) > 2:
            future.set_result(objects.Row(item.name, "done"))
        return future, len(submitted) > 2

    found = list(objects._rows(submit, items, lambda: 2, BrokenProcessPool, alone=True))
    assert sorted(submitted) == ["object0", "object0", "object1", "object1"]
    assert {(row.object, row.result, row.retried) for row in found} == {(i.name, "done", True) for i in items}


COMMAND = """
import sys
from pathlib import Path
from types import SimpleNamespace
from reli3d.cli import infer
from tests.support.jobs import WordJob
log = Path(sys.argv.pop(1))
def made(args, device, budget):
    return WordJob(log)
sys.modules["reli3d.cli.job"] = SimpleNamespace(FolderJob=made, worker=None)
infer.choose_device = lambda device: "cpu"
infer.functools = SimpleNamespace(partial=lambda *_: made(None, None, None).start())
{}
sys.exit(infer.main())
"""
# Delivers SIGINT to a thread other than the main one, which then waits undisturbed.
INTERRUPT = """
import signal, threading, time
def interrupt(waits=[Path(a) / "waits" for a in sys.argv[3:5]]):
    while not all(w.exists() for w in waits):
        time.sleep(0.05)
    time.sleep(0.5)
    signal.pthread_kill(threading.get_ident(), signal.SIGINT)
threading.Thread(target=interrupt, daemon=True).start()
"""


def command(tmp_path, *arguments, code: str = "") -> subprocess.Popen:
    return subprocess.Popen(
        [sys.executable, "-c", COMMAND.format(code), tmp_path / "log", *map(str, arguments)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        cwd=ROOT,
        preexec_fn=heed_signals,
    )


def until_all_wait(process: subprocess.Popen, items: list[objects.Item]) -> None:
    until = time.monotonic() + 60
    while not all((i.folder / "waits").exists() for i in items):
        assert time.monotonic() < until
        assert process.poll() is None, process.communicate()
        time.sleep(0.05)


@pytest.mark.skipif(os.name == "nt", reason="needs signals")
@pytest.mark.parametrize("number, code", [(signal.SIGINT, 130), (signal.SIGTERM, 143), (None, 130)])
def test_a_signal_ends_all_processes_and_leaves_whole_results(tmp_path, number, code):
    """None: SIGINT that a thread other than the main one receives."""
    items = folders(tmp_path, ["one", "two", "wait", "wait", "five"])
    options = *(i.folder for i in items), "--output", tmp_path / "out", "--workers", 2
    process = command(tmp_path, *options, code="" if number else INTERRUPT)
    if number:
        until_all_wait(process, items[2:4])
        process.send_signal(number)
    out, err = process.communicate(timeout=30)  # the objects wait for a minute
    assert process.returncode == code and err.count("reli3d-infer: ") == 1 and "Traceback" not in err
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == ["object0", "object1", "summary.csv"]
    assert out.count("mesh.glb") == 2
    table = read_table(tmp_path / "out" / "summary.csv")
    assert [(r["object"], r["result"]) for r in table] == [("object0", "done"), ("object1", "done")]


@pytest.mark.skipif(os.name == "nt", reason="needs SIGKILL")
def test_processes_end_when_the_command_is_killed(tmp_path):
    items = folders(tmp_path, ["wait", "wait", "three"])
    process = command(tmp_path, *(i.folder for i in items), "--output", tmp_path / "out", "--workers", 2)
    until_all_wait(process, items[:2])
    process.kill()
    assert process.wait() == -signal.SIGKILL
    process.communicate(timeout=30)  # the streams are open in all processes
    assert not (tmp_path / "log").exists() and list(tmp_path.glob("out/*")) == []  # they removed partial results


def test_the_summary_is_in_the_order_of_the_call_and_survives_every_name(tmp_path):
    table = [
        objects.Row('a"b,c', "done", 1.5, 0.93, 12, True, ("one", "two; three")),
        objects.Row("line\nbreak", "refused", notes=("expected\tthis",)),
        objects.Row("größe", "skipped"),
    ]
    objects.write_summary(tmp_path / "summary.csv", table)
    got = read_table(tmp_path / "summary.csv")
    assert list(got[0]) == ["object", "result", "seconds", "mask_iou", "faces", "retried", "notes"]
    assert list(got[0].values()) == ['a"b,c', "done", "1.5", "0.93", "12", "yes", "one; two; three"]
    assert got[1]["object"] == "line\\nbreak" and got[1]["notes"] == "expected\\tthis" and got[1]["faces"] == ""
    assert got[2]["object"] == "größe"


def test_names_are_different_and_quick_for_many(tmp_path):
    items = objects.items_of([Path("a"), Path("b/a"), Path("a-2"), Path("c/a"), Path("summary.csv")], tmp_path)
    assert [i.name for i in items] == ["a", "a-2", "a-2-2", "a-3", "summary.csv-2"]
    began = time.monotonic()
    assert len({i.name for i in objects.items_of([Path("same")] * 50_000, tmp_path)}) == 50_000
    assert time.monotonic() - began < 20  # a search through all names would take minutes


def test_a_list_names_folders(tmp_path):
    names = ["one", "two/three", "mit größe", "a\u2028b", "c\x85d", "e\x0cf"]  # str.splitlines splits the last three
    (tmp_path / "list.txt").write_bytes("\r\n".join(["", *names, "", "  i \nj\r"]).encode())
    assert objects.listed(tmp_path / "list.txt") == [*map(Path, names), Path("i"), Path("j")]
    (tmp_path / "bom.txt").write_bytes(b"\xef\xbb\xbfone\r\ntwo\r\n")
    assert objects.listed(tmp_path / "bom.txt") == [Path("one"), Path("two")]
    found = objects.items_of([Path("zero"), tmp_path / "bom.txt"], tmp_path)
    assert [item.name for item in found] == ["zero", "one", "two"]
    (tmp_path / "walk.MOV").write_bytes(b"\xff\xfe")  # a video is no list: load_views names the command for it
    assert [item.folder for item in objects.items_of([tmp_path / "walk.MOV"], tmp_path)] == [tmp_path / "walk.MOV"]
    (tmp_path / "empty").write_text("\n \n")
    (tmp_path / "bytes").write_bytes(b"\xff\xfe")
    for name, word in (("empty", "got none"), ("bytes", "UTF-8"), ("missing", "not found"), (".", "regular file")):
        with pytest.raises(InputError, match=word):
            objects.listed(tmp_path / name)


@pytest.mark.slow
@pytest.mark.parametrize("options", [["--workers", "1"], ["--workers", "2"], ["--ray", "local"]])
def test_results_are_bitwise_identical_wherever_an_object_is_made(tmp_path, options):
    if "--ray" in options:
        pytest.importorskip("ray")
    for name in ("first", "second", "third"):
        (tmp_path / name).symlink_to(infer.EXAMPLE)
    names = [str(tmp_path / name) for name in ("first", "second", "third")]
    call = [sys.executable, "-m", "reli3d.cli.infer", *QUICK, "--output"]
    alone = [*call, str(tmp_path / "alone"), names[0]]
    subprocess.run(alone, check=True, env={**os.environ, "OMP_NUM_THREADS": "1"}, cwd=ROOT)
    whole = [*call, str(tmp_path / "out"), *options, *names]
    done = subprocess.run(whole, check=True, cwd=ROOT, stdout=subprocess.PIPE, text=True)
    assert done.stdout.count("mesh.glb") == 3
    for name in ("mesh.glb", "environment.exr", "environment.hdr", "preview.png"):
        for folder in ("first", "second", "third"):
            expected = (tmp_path / "alone" / "first" / name).read_bytes()
            assert (tmp_path / "out" / folder / name).read_bytes() == expected
    table = read_table(tmp_path / "out" / "summary.csv")
    info = json.loads((tmp_path / "out/third/run_info.json").read_text())
    assert [r["object"] for r in table] == ["first", "second", "third"]
    assert float(table[2]["mask_iou"]) == info["mask_iou"] > 0.8 and int(table[2]["faces"]) == info["mesh"]["faces"]
