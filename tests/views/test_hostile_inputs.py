"""Every hostile input ends in one clear line and leaves nothing behind."""

from pathlib import Path

import pytest

from reli3d.errors import InputError
from reli3d.io.hdr import read_environment
from reli3d.views.folder import load_views
from tests.support import hostile, hostile_maps


def listing(folder: Path) -> list:
    return sorted((str(p), p.lstat().st_size, p.lstat().st_mtime_ns) for p in folder.rglob("*"))


def one_clear_line(error: BaseException) -> None:
    text = str(error)
    assert type(error) is InputError  # a ValueError; nothing of the decoder or of Python's file calls leaks through
    assert text.isprintable() and len(text) < 600, text
    assert ": " in text and ("; " in text or "expected" in text), text  # names a place, and what to do


def test_the_untouched_folders_load(tmp_path):
    hostile.good(tmp_path / "json")
    hostile.colmap(tmp_path / "colmap")
    assert len(load_views(tmp_path / "json")) == len(load_views(tmp_path / "colmap")) == 3
    (tmp_path / "good.exr").write_bytes(hostile_maps.exr_bytes())
    assert read_environment(tmp_path / "good.exr").radiance.shape == (16, 32, 3)


@pytest.mark.parametrize("name, make", hostile.cases(), ids=[name for name, _ in hostile.cases()])
def test_a_malformed_folder_gives_one_line(tmp_path, capfd, name, make):
    make(tmp_path / "object")
    before = listing(tmp_path)
    with pytest.raises(InputError) as caught:
        load_views(tmp_path / "object")
    one_clear_line(caught.value)
    assert listing(tmp_path) == before
    assert capfd.readouterr() == ("", "")  # nothing but the error


@pytest.mark.parametrize("name, content", hostile_maps.cases(), ids=[name for name, _ in hostile_maps.cases()])
def test_a_malformed_map_gives_one_line(tmp_path, capfd, name, content):
    path = tmp_path / "map.hdr"
    path.write_bytes(content)
    with pytest.raises(InputError) as caught:
        read_environment(path)
    one_clear_line(caught.value)
    assert capfd.readouterr() == ("", "")
