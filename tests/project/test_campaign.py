"""The campaign finds planted faults, and none in the readers."""

import dataclasses
import os
import signal
import sys
import tempfile
import time
from random import Random

import pytest

from reli3d.io.glb import read_glb
from reli3d.io.hdr import read_hdr_image
from reli3d.output.folder import claimed
from reli3d.views.folder import load_views
from reli3d.views.views import Views
from tests import campaign
from tests.support import known
from tests.support.known import KINDS
from tests.support.misread import Misread
from tests.support.readers import Target, targets

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="needs fork and /proc")
NAMES = ("a", "b", "c")


@pytest.fixture
def small_threads(threads):
    threads(1)  # a fork does not inherit torch's threads


def fault_of(read, before=lambda folder: None) -> str:
    """Of the second of two inputs, of which the first is read by ``before``."""
    inputs = [(Target("planted", {"a.txt": b"one"}, r), 0, {"a.txt": b"one"}) for r in (before, read)]
    return [o.fault for o in campaign.outcomes(inputs)][1]


def raises(error):
    def read(folder):
        raise error

    return read


def busy(seconds: float):
    def read(folder):
        began = time.process_time()
        while time.process_time() < began + seconds:
            pass

    return read


ALLOWED = [
    lambda folder: (folder / "a.txt").read_bytes(),
    raises(ValueError("a: expected b")),
    raises(OSError(2, "none")),
]
PLANTED = [
    *(
        ("wrong", raises(e))
        for e in (KeyError("x"), RuntimeError(), MemoryError(), SystemExit(3), ValueError("two\nlines"))
    ),
    ("wrong", raises(ValueError())),
    ("slow", busy(0.5)),
    (("crash", "slow"), busy(60.0)),  # ended by the limit on the processor's time, or of the wait on a busy machine
    ("slow", lambda folder: time.sleep(60)),
    ("crash", lambda folder: os.kill(os.getpid(), signal.SIGSEGV)),
]


def test_planted_faults_are_found_and_leave_no_files(small_threads, monkeypatch, tmp_path):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    monkeypatch.setattr(campaign, "SECONDS", 0.2)
    monkeypatch.setattr(campaign, "WALL", 3.0)
    for read in ALLOWED:
        assert fault_of(read, PLANTED[-1][1]) == ""  # after a crash the rest goes to another process
    for kind, read in PLANTED:
        assert fault_of(read).startswith(kind), (kind, read)
    monkeypatch.setattr(campaign, "SECONDS", 5.0)  # writing 128 MiB may take longer than the limits above
    monkeypatch.setattr(campaign, "WALL", 60.0)
    monkeypatch.setattr(campaign, "MEMORY", 1 << 26)

    def kept(folder):
        return bytearray(b"x") * (1 << 27)

    def freed(folder):  # 256 MiB in pieces, which the heap keeps
        del [bytearray(b"x") * (1 << 16) for _ in range(1 << 12)][:-1]

    assert fault_of(kept).startswith("memory") and fault_of(kept, freed).startswith("memory")
    assert not list(tmp_path.iterdir())


def test_good_files_are_accepted(tmp_path, small_threads):
    def accepted(read):
        def only(folder):
            try:
                read(folder)
            except (ValueError, OSError) as error:
                raise AssertionError(error) from error

        return only

    found = [dataclasses.replace(t, read=accepted(t.read)) for t in targets(tmp_path) if not t.known]
    assert [o.fault for o in campaign.outcomes([(t, 0, t.files) for t in found])] == [""] * len(found)


@pytest.mark.parametrize("count", [140, pytest.param(10_000, marks=pytest.mark.slow)])
def test_hostile_inputs_are_read_or_refused_in_one_line(tmp_path, small_threads, count):
    found = targets(tmp_path)
    ended = list(campaign.outcomes([campaign.drawn(found, 20, number) for number in range(count)]))
    assert len(ended) == count and [(o.name, o.fault) for o in ended if o.fault] == []


def test_an_input_read_as_another_fails(tmp_path, small_threads, monkeypatch):
    """The campaign's own power: a reader whose masks are half transparent, and one that refuses nothing."""
    cases = {name: [make(Random(seed)) for seed in range(12)] for name, make in KINDS.items()}
    monkeypatch.setattr(known, "load_views", lambda folder, **options: faded(load_views(folder, **options)))
    monkeypatch.setattr(known, "read_hdr_image", lambda path, **options: 2 * read_hdr_image(path, **options))
    monkeypatch.setattr(known, "read_glb", lambda path, **options: 2 * read_glb(path, **options))
    for name, some in cases.items():
        kinds = set()
        for k, case in enumerate(some):
            folder = tmp_path / f"{name}-{k}"
            campaign.write(folder, case.files)
            try:
                case.read(folder)
                kinds.add("right")
            except (Misread, ValueError, OSError) as error:
                kinds.add(type(error).__name__)
        assert "Misread" in kinds and "right" not in kinds, name


def faded(views: Views) -> Views:
    masks = tuple(mask / 2 for mask in views.masks)
    return dataclasses.replace(views, masks=masks, c2w=views.c2w.roll(1, 0))


@pytest.mark.parametrize("kills", [10, pytest.param(200, marks=pytest.mark.slow)])
def test_kills_at_random_moments_leave_one_whole_result(tmp_path, kills):
    """A process that exchanges results as fast as it can, killed at random moments."""
    folder, rng, seen = tmp_path / "out" / "name", Random(7), set()
    for k in range(kills):
        pid = os.fork()
        if pid == 0:
            try:
                for word in range(10**9):
                    with claimed(folder, NAMES) as replacing, replacing() as new:
                        for name in NAMES:
                            (new / name).write_text(f"{os.getpid()} {word}")
            finally:
                os._exit(1)
        while k % 2 and not (folder.exists() and (folder / NAMES[0]).read_text().startswith(f"{pid} ")):
            time.sleep(0.001)  # until it wrote a result
        time.sleep(rng.uniform(0.0, 0.05))
        os.kill(pid, signal.SIGKILL)
        os.waitpid(pid, 0)
        if folder.exists():  # the state for other processes
            assert len({(folder / name).read_text() for name in NAMES}) == 1
        with claimed(folder, NAMES):  # the next start
            words = {(folder / name).read_text() for name in NAMES} if folder.exists() else {"none"}
        assert len(words) == 1
        seen |= words
        assert not folder.parent.exists() or {p.name for p in folder.parent.iterdir()} <= {"name"}
    assert len(seen) >= kills // 2
