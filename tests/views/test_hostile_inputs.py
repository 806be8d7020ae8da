"""Every hostile input ends in one clear line and leaves nothing behind."""

from pathlib import Path

import pytest

from reli3d.errors import InputError
from reli3d.io.hdr import read_environment
from reli3d.views.folder import load_views
from tests.support import hostile, hostile_maps


def listing(folder: Path) -> list:
    return sorted((str(p), p.lstat().st_size, p.lstat().st_mtime_ns) for p in folder.rglob("*"))


def test_the_untouched_folders_load(tmp_path):
    hostile.good(tmp_path / "json")
    hostile.colmap(tmp_path / "colmap")
    assert len(load_views(tmp_path / "json")) == len(load_views(tmp_path / "colmap")) == 3
    (tmp_path / "good.exr").write_bytes(hostile_maps.exr_bytes())
    assert read_environment(tmp_path / "good.exr").radiance.shape == (16, 32, 3)


CASES = [
    *((name, make, load_views) for name, make in hostile.cases()),
    *(
        (name, lambda path, content=content: path.write_bytes(content), read_environment)
        for name, content in hostile_maps.cases()
    ),
]


@pytest.mark.parametrize("make, read", [case[1:] for case in CASES], ids=[case[0] for case in CASES])
def test_a_malformed_input_gives_one_line(tmp_path, capfd, make, read):
    make(tmp_path / "object")
    before = listing(tmp_path)
    with pytest.raises(InputError) as caught:
        read(tmp_path / "object")
    text = str(caught.value)
    assert type(caught.value) is InputError  # nothing of the decoder or of Python's file calls leaks through
    assert text.isprintable() and len(text) < 600, text
    assert ": " in text and ("; " in text or "expected" in text), text  # names a place, and what to do
    assert listing(tmp_path) == before
    assert capfd.readouterr() == ("", "")  # nothing but the error
