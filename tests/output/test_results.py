"""A result folder changes at once: whatever is killed, whenever, the old result is there or the new one."""

import contextlib
import errno
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from reli3d.errors import InputError
from reli3d.output.folder import check_place, claimed

OURS = ("a", "b", "c")

# One result whose files all have the same word; killed at the N-th audited file operation.
WRITER = """
import os, signal, sys
from pathlib import Path
from reli3d.output import folder as module
from reli3d.output.folder import claimed
folder, word, last = Path(sys.argv[1]), sys.argv[2], int(sys.argv[3])
count, real = 0, module.exchanged
def exchanged(*names):
    hook("exchange", ())
    done = real(*names) if sys.argv[4:] != ["renames"] else False
    hook("exchange", ())
    return done
module.exchanged = exchanged
def hook(event, args):
    global count
    if event in ("open", "exchange", "shutil.rmtree") or event.startswith("os."):
        count += 1
        if count == last:
            os.kill(os.getpid(), signal.SIGKILL)
sys.addaudithook(hook)
with claimed(folder, ("a", "b", "c")) as replacing:
    with replacing() as new:
        for name in "abc":
            (new / name).write_text(word)
print(count)
"""


def put(folder: Path, word: str) -> None:
    with claimed(folder, OURS) as replacing, replacing() as new:
        for name in OURS:
            (new / name).write_text(word)


def words(folder: Path) -> set[str]:
    return {(folder / name).read_text() for name in OURS}


def write(folder: Path, word: str, last: int, *how: str) -> subprocess.CompletedProcess:
    command = [sys.executable, "-c", WRITER, folder, word, str(last), *how]
    return subprocess.run(command, capture_output=True, text=True)


@pytest.mark.skipif(os.name == "nt", reason="needs SIGKILL")
@pytest.mark.parametrize("before, how", [(True, "exchange"), (True, "renames"), (False, "exchange")])
def test_a_kill_at_any_operation_leaves_one_whole_result_and_every_foreign_file(tmp_path, before, how):
    """renames: as on a system that cannot exchange two folders in one step."""
    folder = tmp_path / "out" / "name"
    outcomes, last = set(), 0
    while True:
        last += 1
        if folder.exists():
            for path in folder.iterdir():
                path.unlink()
            folder.rmdir()
        if before:
            put(folder, "old")
            (folder / "notes.txt").write_text("mine")
        done = write(folder, "new", last, *(["renames"] if how == "renames" else []))
        assert done.returncode in (0, -signal.SIGKILL), done.stderr
        if before and how == "exchange" and sys.platform == "linux":
            assert folder.exists()  # at every moment
        if folder.exists():  # the state for other processes: never a mixture
            assert len(words(folder)) == 1
        with claimed(folder, OURS):  # the next start
            found = words(folder) if folder.exists() else {"none"}
        assert len(found) == 1
        outcomes |= found
        if before:
            assert (folder / "notes.txt").read_text() == "mine"
        assert sorted(p.name for p in (tmp_path / "out").glob("*")) == (["name"] if folder.exists() else [])
        if done.returncode == 0:
            break
    assert last > 10 and outcomes == ({"old", "new"} if before else {"none", "new"})


@pytest.mark.parametrize("name", ["n" * 250, "ö" * 127, b"caf\xe9 \xff".decode(errors="surrogateescape")])
def test_long_names_and_names_that_are_not_utf8_take_a_result(tmp_path, name):
    folder = tmp_path / "out" / name
    assert check_place(folder) == Path(os.path.realpath(folder))
    for word in ("old", "new"):
        put(folder, word)
    assert words(folder) == {"new"} and os.listdir(os.fsencode(tmp_path / "out")) == [os.fsencode(name)]


def test_files_of_the_old_result_do_not_stay_and_foreign_ones_do(tmp_path):
    folder = tmp_path / "name"
    put(folder, "old")
    (folder / "rgba").mkdir()
    (folder / "rgba" / "0.png").write_text("photograph")
    (folder / "link").symlink_to("nowhere")
    with claimed(folder, OURS) as replacing, replacing() as new:
        (new / "a").write_text("new")
    assert sorted(p.name for p in folder.iterdir()) == ["a", "link", "rgba"]
    assert (folder / "rgba" / "0.png").read_text() == "photograph" and (folder / "link").is_symlink()


def test_an_error_leaves_the_old_result_and_nothing_else(tmp_path):
    put(tmp_path / "name", "old")
    for folder in (tmp_path / "name", tmp_path / "far" / "away" / "other"):
        with pytest.raises(RuntimeError), claimed(folder, OURS) as replacing, replacing() as new:
            (new / "a").write_text("half")
            raise RuntimeError
    assert [p.name for p in tmp_path.iterdir()] == ["name"] and words(tmp_path / "name") == {"old"}


def test_a_link_to_a_folder_stays_one(tmp_path):
    (tmp_path / "disk").mkdir()
    (tmp_path / "name").symlink_to("disk")
    put(tmp_path / "name", "new")
    assert (tmp_path / "name").is_symlink() and words(tmp_path / "disk") == {"new"}


@pytest.mark.skipif(os.name == "nt", reason="needs locks of files")
def test_of_two_processes_one_reports_it_at_its_start(tmp_path):
    folder = tmp_path / "name"
    with claimed(folder, OURS) as replacing, replacing() as new:
        began = time.monotonic()
        second = write(folder, "second", 0)
        assert second.returncode == 1 and "got one at work" in second.stderr.splitlines()[-1]
        assert time.monotonic() - began < 30  # it does not wait; a Python's start on a busy machine
        for name in OURS:
            (new / name).write_text("first")
    assert words(folder) == {"first"} and [p.name for p in tmp_path.iterdir()] == ["name"]


def test_a_folder_that_another_process_removes_meanwhile_is_made_again(tmp_path, monkeypatch):
    made, make = [], os.mkdir

    def removed_meanwhile(path, *args):
        made.append(Path(path).name)
        if made.count(".name.partial") == 1 and made[-1] == ".name.partial":
            raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST), path)
        make(path, *args)

    monkeypatch.setattr(os, "mkdir", removed_meanwhile)
    put(tmp_path / "name", "new")
    assert made.count(".name.partial") == 2 and words(tmp_path / "name") == {"new"}


@pytest.mark.skipif(os.name == "nt", reason="needs locks of files")
def test_many_processes_at_one_result_leave_one_of_theirs(tmp_path):
    folder = tmp_path / "name"
    pipes = dict(stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
    running = [subprocess.Popen([sys.executable, "-c", WRITER, folder, str(k), "0"], **pipes) for k in range(6)]
    output = [process.communicate()[1] for process in running]
    assert any(process.returncode == 0 for process in running)
    for process, text in zip(running, output, strict=True):
        assert process.returncode == 0 or "got one at work" in text.splitlines()[-1]
    assert len(words(folder)) == 1 and [p.name for p in tmp_path.iterdir()] == ["name"]


def test_leftovers_of_a_killed_process_do_not_block(tmp_path):
    left = tmp_path / ".name.partial" / "new"
    left.mkdir(parents=True)
    (left / "a").write_text("half")
    (left.parent / "lock").touch()
    put(tmp_path / "name", "new")
    assert words(tmp_path / "name") == {"new"} and [p.name for p in tmp_path.iterdir()] == ["name"]


@pytest.mark.parametrize(
    "place, text",
    [
        ("file", "got a file"),
        ("file/name", "got a file"),
        ("x" * 256, "at most 255 bytes"),
        (f"no/{'y' * 300}/name", "at most 255 bytes"),
    ],
)
def test_a_place_that_cannot_take_a_result_is_refused_in_one_line(tmp_path, place, text):
    (tmp_path / "file").touch()
    with pytest.raises(InputError) as refused:
        check_place(tmp_path / place)
    assert text in str(refused.value) and "\n" not in str(refused.value)
    str(refused.value).encode()  # it can be printed
    with pytest.raises(InputError), claimed(tmp_path / place, OURS):
        pass
    assert [p.name for p in tmp_path.iterdir()] == ["file"]


def test_a_folder_that_cannot_be_written_is_refused(tmp_path, monkeypatch):
    (tmp_path / "locked").mkdir()
    real = os.access
    monkeypatch.setattr(os, "access", lambda path, mode: Path(path).name != "locked" and real(path, mode))  # also root
    for place in ("locked", "locked/name", "locked/far/name"):
        with pytest.raises(InputError, match="cannot"):
            check_place(tmp_path / place)
    with contextlib.suppress(OSError):
        assert check_place(tmp_path / "free")
