"""Every hostile input ends in one clear line and leaves nothing behind."""

import subprocess
import sys
from pathlib import Path

import pytest

from reli3d.errors import InputError
from reli3d.io.hdr import read_environment
from reli3d.views.folder import load_views
from tests.support import evil, evil_maps
from tests.support.checkout import ROOT


def listing(folder: Path) -> list:
    return sorted((str(p), p.lstat().st_size, p.lstat().st_mtime_ns) for p in folder.rglob("*"))


def one_clear_line(error: BaseException) -> None:
    text = str(error)
    assert type(error) is InputError  # a ValueError; nothing of the decoder or of Python's file calls leaks through
    assert text.isprintable() and len(text) < 600, text
    assert ": " in text and ("; " in text or "expected" in text), text  # names a place, and what to do


def test_there_are_enough_cases():
    assert len(evil.cases()) >= 60
    names = [name for name, _ in evil.cases()]
    assert len(set(names)) == len(names)


def test_the_untouched_folders_load(tmp_path):
    evil.good(tmp_path / "json")
    evil.colmap(tmp_path / "colmap")
    assert len(load_views(tmp_path / "json")) == len(load_views(tmp_path / "colmap")) == 3
    (tmp_path / "good.exr").write_bytes(evil_maps.exr_bytes())
    assert read_environment(tmp_path / "good.exr").radiance.shape == (16, 32, 3)


@pytest.mark.parametrize("name, make", evil.cases(), ids=[name for name, _ in evil.cases()])
def test_a_malformed_folder_gives_one_line(tmp_path, capfd, name, make):
    make(tmp_path / "object")
    before = listing(tmp_path)
    with pytest.raises(InputError) as caught:
        load_views(tmp_path / "object")
    one_clear_line(caught.value)
    assert listing(tmp_path) == before
    assert capfd.readouterr() == ("", "")  # the error is all there is to say


@pytest.mark.parametrize("name, content", evil_maps.cases(), ids=[name for name, _ in evil_maps.cases()])
def test_a_malformed_map_gives_one_line(tmp_path, capfd, name, content):
    path = tmp_path / "map.hdr"
    path.write_bytes(content)
    with pytest.raises(InputError) as caught:
        read_environment(path)
    one_clear_line(caught.value)
    assert capfd.readouterr() == ("", "")


FUZZ = """
import random, resource, sys
from pathlib import Path
import torch
torch.set_num_threads(1)
from reli3d.views.folder import load_views
from reli3d.errors import InputError
from reli3d.io.hdr import read_environment
from tests.support import evil, evil_maps
used = int(open("/proc/self/statm").read().split()[0]) * resource.getpagesize()
resource.setrlimit(resource.RLIMIT_AS, (used + (1 << 30),) * 2)
root, random = Path(sys.argv[1]), random.Random(5)
evil.good(root / "object", views=1)
seeds = [(root / "object/transforms.json", load_views, root / "object"),
         (root / "object/rgba/0.png", load_views, root / "object")]
for name, content in (("a.exr", evil_maps.exr_bytes()), ("b.hdr", Path(sys.argv[2]).read_bytes())):
    (root / name).write_bytes(content)
    seeds.append((root / name, read_environment, root / name))
accepted = refused = 0
for path, reader, argument in seeds:
    original = path.read_bytes()
    for _ in range(int(sys.argv[3])):
        data = bytearray(original)
        for _ in range(random.randint(1, 4)):
            at = random.randrange(len(data))
            new = bytes(random.randrange(256) for _ in range(random.choice((0, 1, 1, 4))))
            data[at:at + random.choice((0, 1, 1, 1, 4))] = new
        path.write_bytes(data)
        try:
            reader(argument)
            accepted += 1
        except InputError as error:
            assert str(error).isprintable()
            refused += 1
    path.write_bytes(original)
print("accepted", accepted, "refused", refused)
"""


@pytest.mark.parametrize("rounds", [60, pytest.param(3000, marks=pytest.mark.slow)])
def test_random_damage_is_read_or_refused(tmp_path, rounds):
    """A process of its own with 1 GB on top of its libraries: a crash or a claimed gigabyte shows as its exit code."""
    import torch

    from reli3d.io.hdr import write_hdr

    write_hdr(tmp_path / "seed.hdr", torch.rand(16, 32, 3, generator=torch.Generator().manual_seed(0)))
    done = subprocess.run(
        [sys.executable, "-c", FUZZ, tmp_path, tmp_path / "seed.hdr", str(rounds)],
        timeout=300,
        cwd=ROOT,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr[-2000:]
    assert "accepted" in done.stdout
