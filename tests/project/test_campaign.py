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


def outcomes(read, count: int = 3):
    target = Target("planted", {"a.txt": b"one"}, read)
    return list(campaign.in_fork([(k, target, []) for k in range(count)]))


def test_every_kind_of_fault_is_distinguished_and_none_leaves_files(small_threads, monkeypatch, tmp_path):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    monkeypatch.setattr(campaign, "SECONDS", 0.2)
    monkeypatch.setattr(campaign, "MEMORY", 1 << 26)
    monkeypatch.setattr(campaign, "WALL", 3.0)

    def raises(error):
        def read(folder):
            raise error

        return read

    def busy(seconds):
        def read(folder):
            began = time.process_time()
            while time.process_time() < began + seconds:
                pass

        return read

    def kept(folder):
        return bytearray(b"x") * (1 << 27)

    assert [o.kind for o in outcomes(lambda folder: (folder / "a.txt").read_bytes())] == ["accepted"] * 3
    assert [o.kind for o in outcomes(raises(ValueError("a: expected b")))] == ["refused"] * 3
    assert [o.kind for o in outcomes(raises(OSError(2, "none")))] == ["refused"] * 3
    for error in (KeyError("x"), RuntimeError(), MemoryError(), SystemExit(3), ValueError("two\nlines"), ValueError()):
        assert [o.kind for o in outcomes(raises(error))] == ["wrong"] * 3, error
    assert [o.kind for o in outcomes(busy(0.5), 1)] == ["slow"]
    assert [o.kind for o in outcomes(busy(60.0), 1)] == ["slow"]  # ended by the limit on the processor's time
    assert [o.kind for o in outcomes(lambda folder: time.sleep(60), 1)] == ["slow"]
    monkeypatch.setattr(campaign, "SECONDS", 5.0)  # writing 128 MiB may take longer than the limits above
    monkeypatch.setattr(campaign, "WALL", 60.0)
    assert [o.kind for o in outcomes(kept, 1)] == ["memory"]
    free = [bytearray(b"x") * (1 << 16) for _ in range(1 << 12)]  # 256 MiB in pieces, which the heap keeps when freed
    del free[:-1]
    assert [o.kind for o in outcomes(kept, 1)] == ["memory"]
    (crash,) = outcomes(lambda folder: os.kill(os.getpid(), signal.SIGSEGV))  # the rest goes to another process
    assert (crash.kind, crash.text) == ("crash", "SIGSEGV")
    assert list(tmp_path.iterdir()) == []


def test_good_files_are_accepted(tmp_path, small_threads):
    found = [target for target in targets(tmp_path) if not target.known]
    assert [o.kind for o in campaign.in_fork([(k, t, []) for k, t in enumerate(found)])] == ["accepted"] * len(found)


@pytest.mark.parametrize("count", [140, pytest.param(10_000, marks=pytest.mark.slow)])
def test_hostile_inputs_are_read_or_refused_in_one_line(tmp_path, small_threads, count):
    found = campaign.Campaign(20, targets(tmp_path / "good"), tmp_path / "findings")
    assert found.run(count, time.monotonic() + 3600) == count
    assert found.failed == [], found.report()


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
