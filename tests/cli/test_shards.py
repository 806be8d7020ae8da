"""Tar files of objects in, shards of results out: as with folders, and nothing is lost where a process is killed."""

import csv
import json
import os
import signal
import subprocess
import sys
import tarfile
import time
from pathlib import Path

import pytest
import torch

from reli3d.cli import data, infer, objects
from reli3d.cli.shard_writer import open_shards
from reli3d.io import shards
from reli3d.io.files import InputError
from reli3d.io.tar import packed_objects
from reli3d.output import results
from reli3d.views.folder import load_views
from tests.support import evil, tars
from tests.support.checkout import ROOT
from tests.support.jobs import FILES, Start, WordJob

WORDS = ["one", "die once", "three", "refuse", "die", "six", "fail"]
WITH_RAY = pytest.param("ray", marks=pytest.mark.slow)  # its cluster takes half a minute to start


def shard_of(root: Path, words: list[str]) -> Path:
    for k, word in enumerate(words):
        (root / "in" / f"object.{k}").mkdir(parents=True)
        (root / "in" / f"object.{k}" / "word").write_text(word)
    return tars.packed(root / "in", root / "000000.tar")


@pytest.fixture
def command(tmp_path, monkeypatch):
    monkeypatch.setattr(infer, "Job", lambda args, device: WordJob(tmp_path / "log"))
    return lambda *arguments: infer.main([*map(str, arguments), "--output", str(tmp_path / "out")])


def log(tmp_path: Path) -> list[str]:
    return (tmp_path / "log").read_text().split() if (tmp_path / "log").exists() else []


def table(tmp_path: Path) -> dict[str, str]:
    with open(tmp_path / "out" / "summary.csv", newline="") as file:
        return {row["object"]: row["result"] for row in csv.DictReader(file)}


def packed(out: Path) -> dict[str, str]:
    """The word of each object in the shards that count, each of which is there once."""
    found = {}
    for row in shards.read_index(out):
        assert shards.fault(out, row, hashed=True) is None
        inside = packed_objects(out / row["shard"])
        assert [one.name for one in inside] == row["objects"]
        for one in inside:
            assert one.name not in found and set(one.files()) == set(FILES)
            with one.unpacked() as folder:
                found[one.name] = (folder / "mesh.glb").read_text()
    return found


def test_the_files_of_the_job_are_those_of_a_result():
    assert results.FILES == FILES


@pytest.mark.parametrize("where", ["here", "processes", WITH_RAY])
def test_objects_of_a_tar_file_are_made_as_those_of_folders(tmp_path, where):
    words = [w for w in WORDS if where != "here" or "die" not in w]
    items = objects.items_of(objects.sources([shard_of(tmp_path, words)]), tmp_path / "out")
    start = Start(tmp_path / "log")
    if where == "ray":
        pytest.importorskip("ray")
        rows = list(objects.on_ray(start, items, "local"))
    elif where == "processes":
        rows = list(objects.in_processes(start, items, 2))
    else:
        rows = [objects.make(start(), item) for item in items]
    result = {row.object: row.result for row in rows}
    known = {"refuse": "refused", "fail": "failed", "die": "failed"}
    assert result == {f"object.{k}": known.get(word, "done") for k, word in enumerate(words)}
    done = [item for item, word in zip(items, words, strict=True) if word not in known]
    assert sorted(log(tmp_path)) == sorted(item.name for item in done)  # each once
    for item, word in zip(items, words, strict=True):
        assert item.target.exists() == (item in done)
        assert word in known or (item.target / "mesh.glb").read_text() == word


def test_the_photographs_of_a_tar_file_are_those_of_the_folder(tmp_path, capsys):
    evil.good(tmp_path / "in" / "disk")
    (tmp_path / "in" / "none").mkdir()
    (tmp_path / "in" / "none" / "photo.png").write_bytes(b"")
    shard = tars.packed(tmp_path / "in", tmp_path / "a.tar")
    one, two = packed_objects(shard)
    wanted = load_views(tmp_path / "in" / "disk")
    with one.unpacked() as folder:
        got = load_views(folder)
    assert not folder.exists() and got.names == wanted.names and torch.equal(got.c2w, wanted.c2w)
    assert all(torch.equal(a, b) for a, b in zip(got.images, wanted.images, strict=True))
    assert infer.main([str(shard), "--check", "--output", str(tmp_path / "out")]) == 1
    out, err = capsys.readouterr()
    assert (tmp_path / "out" / "disk" / "rig.png").exists() and "rig.png" in out
    assert f"{shard}/none" in err and err.count("\n") == 1


@pytest.mark.parametrize("name", ["absolute", "above", "symlink", "device", "claims_2_40", "twice", "cut", "text"])
def test_hostile_tar_files_end_with_2_before_the_work(tmp_path, capsys, monkeypatch, name):
    monkeypatch.setattr(infer, "Job", None)  # a call raises TypeError
    (tmp_path / "a.tar").write_bytes({n: make for n, make, _ in tars.hostile()}[name]())
    (tmp_path / "list").write_text(f"{tmp_path}/a.tar\n")
    for source in ([str(tmp_path / "a.tar")], ["--list", str(tmp_path / "list")]):
        assert infer.main([*source, "--output", str(tmp_path / "out")]) == 2
        out, err = capsys.readouterr()
        assert out == "" and err.count("\n") == 1 and "a.tar" in err
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.tar", "list"]


@pytest.mark.parametrize(
    "options, word",
    [
        (["a.tar"], "not found"),
        (["--shards-out", "0"], "--shards-out"),
        (["--shards-out", "4", "--check"], "--check"),
    ],
)
def test_wrong_options_end_with_2_before_the_work(tmp_path, capsys, monkeypatch, options, word):
    monkeypatch.setattr(infer, "Job", None)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "good.tar").write_bytes(tars.written(*tars.GOOD))
    assert infer.main([*options, "--output", "out"]) == 2
    err = capsys.readouterr().err
    assert err.count("\n") == 1 and word in err and not (tmp_path / "out").exists()


def test_results_in_shards(tmp_path, capsys, command):
    import webdataset

    shard = shard_of(tmp_path, ["one", "two", "refuse", "four", "five", "six"])
    assert command(shard, "--shards-out", 2) == 1
    out, names = tmp_path / "out", ["object_0", "object_1", "object_3", "object_4", "object_5"]
    lines = capsys.readouterr().out.splitlines()
    assert lines == [str(out / f"00000{k}.tar") for k in range(3)]
    wanted = ["000000.json", "000000.tar", "000001.json", "000001.tar", "000002.json", "000002.tar", "index.json"]
    assert sorted(p.name for p in out.iterdir()) == [*wanted, "summary.csv"]
    assert packed(out) == dict(zip(names, ["one", "two", "four", "five", "six"], strict=True))
    assert table(tmp_path) == {n: "done" for n in names} | {"object_2": "refused"}
    assert data.main(["check", str(out)]) == 0
    samples = list(webdataset.WebDataset(lines, shardshuffle=False))
    assert [s["__key__"] for s in samples] == names and samples[0]["mesh.glb"] == b"one"
    assert json.loads(samples[2]["run_info.json"])["mesh"]["faces"] == 4
    with tarfile.open(lines[0]) as tar:
        assert {m.name for m in tar} == {f"{n}.{f}" for n in names[:2] for f in FILES}


def test_skip_existing_adds_what_is_missing_and_changes_no_shard(tmp_path, capsys, command):
    shard = shard_of(tmp_path, ["one", "two", "three", "four", "five"])
    some = tmp_path / "some.tar"
    some.write_bytes(tars.written(*(tars.entry(f"object.{k}/word", b"word") for k in (0, 3, 4))))
    assert command(some, "--shards-out", 2) == 0
    first = (tmp_path / "out" / "000000.tar").read_bytes()
    assert command(shard, "--shards-out", 2) == 2 and "no shards yet" in capsys.readouterr().err
    assert command(shard, "--shards-out", 2, "--skip-existing", "--json") == 0
    told = json.loads(capsys.readouterr().out)["objects"]
    assert {t["object"]: Path(t["shard"]).name for t in told} == {
        "object_0": "000000.tar",
        "object_3": "000000.tar",
        "object_4": "000001.tar",
        "object_1": "000002.tar",
        "object_2": "000002.tar",
    }
    assert all(t["faces"] for t in told)
    assert (tmp_path / "out" / "000000.tar").read_bytes() == first
    assert sorted(packed(tmp_path / "out")) == [f"object_{k}" for k in range(5)]
    assert sorted(log(tmp_path)) == sorted(packed(tmp_path / "out"))  # each was made once
    assert [r for _, r in sorted(table(tmp_path).items())] == ["skipped", "done", "done", "skipped", "skipped"]


def test_folders_of_results_go_into_shards_and_foreign_files_stay(tmp_path, command):
    shard = shard_of(tmp_path, ["one", "two"])
    out = tmp_path / "out"
    job = WordJob(tmp_path / "log")
    for item in objects.items_of(objects.sources([shard]), out, dots=False):
        objects.make(job, item)
    (out / "object_1" / "notes.txt").write_text("mine")
    assert command(shard, "--shards-out", 5, "--skip-existing") == 0
    assert packed(out) == {"object_0": "one", "object_1": "two"} and len(log(tmp_path)) == 2
    assert [str(p.relative_to(out)) for p in out.rglob("*") if "object" in str(p)] == ["object_1", "object_1/notes.txt"]


def test_what_is_wrong_with_shards_that_are_there_is_told(tmp_path, capsys, command):
    shard = shard_of(tmp_path, ["one", "two", "three"])
    again = [shard, "--shards-out", 2, "--skip-existing"]
    assert command(shard, "--shards-out", 2) == 0
    assert command(*again, "--compatible-names") == 2 and "illumination.hdr" in capsys.readouterr().err
    with open_shards(tmp_path / "out", 2, FILES, more=True):
        assert command(*again) == 2 and "no other process" in capsys.readouterr().err
    path = tmp_path / "out" / "000000.tar"
    path.write_bytes(path.read_bytes()[:-512])
    assert command(*again) == 2 and "000000.json" in capsys.readouterr().err
    path.with_suffix(".json").unlink()
    assert command(*again) == 0
    assert sorted(packed(tmp_path / "out")) == ["object_0", "object_1", "object_2"]
    (tmp_path / "out" / "000001.json").write_text("{")
    assert command(*again) == 2 and "broken file" in capsys.readouterr().err


# Packs the folders of two objects; killed at the N-th file operation that Python announces.
PACKER = """
import os, signal, sys
from pathlib import Path
from reli3d.cli.shard_writer import open_shards
from tests.support.jobs import FILES
last, count = int(sys.argv[2]), 0
def hook(event, args):
    global count
    if event in ("os.rename", "os.mkdir", "os.remove", "os.rmdir", "open", "os.scandir"):
        count += 1
        if count == last:
            os.kill(os.getpid(), signal.SIGKILL)
sys.addaudithook(hook)
with open_shards(Path(sys.argv[1]), 2, FILES, more=True) as writer:
    for name in ("a", "b"):
        if name not in writer.place:
            writer.add(name)
    writer.write()
print(count)
"""


def pack(out: Path, last: int) -> subprocess.CompletedProcess:
    return subprocess.run([sys.executable, "-c", PACKER, out, str(last)], capture_output=True, text=True, cwd=ROOT)


@pytest.mark.skipif(os.name == "nt", reason="needs SIGKILL")
def test_a_kill_at_any_operation_of_packing_loses_nothing(tmp_path):
    def folders(out: Path) -> Path:
        for name in ("a", "b"):
            (out / name).mkdir(parents=True)
            for file in FILES:
                (out / name / file).write_text(name)
        return out

    count = int(pack(folders(tmp_path / "whole"), 0).stdout)
    wanted = {p.name: p.read_bytes() for p in (tmp_path / "whole").iterdir()}
    assert count > 30 and packed(tmp_path / "whole") == {"a": "a", "b": "b"}
    for last in range(1, count + 1, 1 if count < 100 else 3):
        out = folders(tmp_path / f"{last}")
        assert pack(out, last).returncode == -signal.SIGKILL
        with open_shards(out, 2, FILES, more=True) as writer:  # the next call
            for name in ("a", "b"):
                assert name in writer.place or all((out / name / file).read_text() == name for file in FILES), last
                if name not in writer.place:
                    writer.add(name)
            writer.write()
        assert {p.name: p.read_bytes() for p in out.iterdir()} == wanted, last


COMMAND = """
import sys
from pathlib import Path
from types import SimpleNamespace
from reli3d.cli import infer
from tests.support.jobs import Start
root = Path(sys.argv[1])
infer.choose_device = lambda wanted: "cpu"
infer.Job = lambda args, device: None
infer.worker_job = lambda *_: None
infer.functools = SimpleNamespace(partial=lambda *_: Start(root / "log"))
sys.exit(infer.main(sys.argv[2:]))
"""


@pytest.mark.skipif(os.name == "nt", reason="needs SIGKILL")
@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGINT])
def test_a_command_that_is_killed_is_ended_by_the_next(tmp_path, number):
    shard = shard_of(tmp_path, ["one", "two", "three", "wait", "wait", "six"])
    call = [sys.executable, "-c", COMMAND, tmp_path, shard, "--output", tmp_path / "out", "--workers", "2"]
    call += ["--shards-out", "2", "--skip-existing"]
    process = subprocess.Popen(call, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    waiting = [tmp_path / f"object.{k}-marks" for k in (3, 4)]
    until = time.monotonic() + 60
    while not all((mark / "waits").exists() for mark in waiting):
        assert time.monotonic() < until and process.poll() is None, process.communicate()
        time.sleep(0.05)
    process.send_signal(number)
    assert process.wait(timeout=30) == (-number if number == signal.SIGKILL else 130)
    for mark in waiting:
        (mark / "go").touch()
    process.communicate(timeout=30)  # the workers have ended
    before = sorted(log(tmp_path))
    assert len(before) == (5 if number == signal.SIGKILL else 3)
    assert (tmp_path / "out" / "index.json").exists() == (number != signal.SIGKILL)
    done = subprocess.run(call, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    wanted = dict(zip([f"object_{k}" for k in range(6)], ["one", "two", "three", "wait", "wait", "six"], strict=True))
    assert packed(tmp_path / "out") == wanted and sorted(log(tmp_path)) == sorted(wanted)  # each was made once
    assert not [p for p in (tmp_path / "out").iterdir() if p.is_dir()]


def test_a_disk_that_is_full_ends_in_one_line_and_keeps_the_folders(tmp_path, capsys, command, monkeypatch):
    shard = shard_of(tmp_path, ["one", "two"])

    def full(*_):
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(shards, "write_shard", full)
        assert command(shard, "--shards-out", 2) == 2
    err = capsys.readouterr().err
    assert err.count("No space left") == 1 and "Traceback" not in err
    assert sorted(table(tmp_path)) == ["object_0", "object_1"]
    assert command(shard, "--shards-out", 2, "--skip-existing") == 0 and len(packed(tmp_path / "out")) == 2
    assert len(log(tmp_path)) == 2


def test_folders_are_packed_as_they_are_and_found_again(tmp_path, capsys):
    for name in ("lamp", "shoe 1.2", "cup"):
        evil.good(tmp_path / "in" / name)
    (tmp_path / "in" / "cup" / ".DS_Store").touch()
    (tmp_path / "in" / "notes.txt").touch()
    call = ["pack", str(tmp_path / "in"), str(tmp_path / "shards"), "--folders", "--each", "2"]
    assert data.main(call) == 0 and "000001.tar: 1 objects" in capsys.readouterr().err
    assert data.main(call) == 0 and capsys.readouterr().err == ""  # they are there
    assert data.main(["check", str(tmp_path / "shards")]) == 0
    found = [one for k in range(2) for one in packed_objects(tmp_path / "shards" / f"00000{k}.tar")]
    assert [one.name for one in found] == ["cup", "lamp", "shoe 1.2"]
    for one in found:
        assert set(one.files()) == {"transforms.json", *(f"rgba/{k}.png" for k in range(3))}
        with one.unpacked() as folder:
            assert len(load_views(folder)) == 3
    first = (tmp_path / "shards" / "000000.tar").read_bytes()
    assert data.main([*call[:2], str(tmp_path / "two"), *call[3:], "--workers", "2"]) == 0
    assert (tmp_path / "two" / "000000.tar").read_bytes() == first
    capsys.readouterr()
    for wrong in ("none", "in/notes.txt", "in/cup/rgba"):
        assert data.main(["pack", str(tmp_path / wrong), str(tmp_path / "out"), "--folders"]) == 2
        assert capsys.readouterr().err.count("\n") == 1


def test_an_entry_with_another_name_is_refused(tmp_path):
    (tmp_path / "000000.tar").write_bytes(tars.written(*tars.GOOD))
    shards.write_entry(tmp_path, 0, ["a", "b"])
    (tmp_path / "000000.json").rename(tmp_path / "000007.json")
    with pytest.raises(InputError), open_shards(tmp_path, 2, FILES, more=True):
        pass
