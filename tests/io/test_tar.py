"""Objects in tar files: what any writer packs is read, and nothing hostile is, nor written anywhere."""

import tarfile
import time
from random import Random

import pytest

from reli3d.io import tar
from reli3d.io.files import InputError
from reli3d.io.tar import packed_objects
from tests.support import tars
from tests.support.mutators import damaged

HOSTILE = tars.hostile()


def content(found: tar.Packed) -> dict[str, bytes]:
    with found.unpacked() as root:
        files = [p for p in sorted(root.rglob("*")) if p.is_file()]
        return {p.relative_to(root).as_posix(): p.read_bytes() for p in files}


@pytest.mark.parametrize("form", [tarfile.PAX_FORMAT, tarfile.GNU_FORMAT, tarfile.USTAR_FORMAT])
def test_folders_come_out_as_they_went_in(tmp_path, form):
    long = "y" * 90 + "/" + "z" * 120 if form != tarfile.USTAR_FORMAT else "y" * 90 + "/z"
    wanted = {
        "lamp 1.2": {"transforms.json": b"{}", "rgba/0.png": b"0" * 511, "rgba/1.png": b"1" * 512},
        "größe": {"empty": b"", long: b"2" * 5000},
    }
    for name, files in wanted.items():
        for file, data in files.items():
            path = tmp_path / "folders" / name / file
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(data)
    (tmp_path / "folders" / "lamp 1.2" / "._rgba").write_bytes(b"of a Mac")
    found = packed_objects(tars.packed(tmp_path / "folders", tmp_path / "a.tar", form))
    assert {one.name: content(one) for one in found} == wanted


def test_samples_of_webdataset_are_objects(tmp_path):
    from webdataset import TarWriter

    with TarWriter(str(tmp_path / "a.tar")) as writer:
        for name in ("shoe", "lamp"):
            writer.write({"__key__": name, "transforms.json": {"frames": []}, "0.png": b"png of " + name.encode()})
    found = {one.name: content(one) for one in packed_objects(tmp_path / "a.tar")}
    assert list(found) == ["shoe", "lamp"]
    assert found["lamp"] == {"transforms.json": b'{"frames": []}', "0.png": b"png of lamp"}


@pytest.mark.parametrize("name, make, word", HOSTILE, ids=[name for name, *_ in HOSTILE])
def test_hostile_tar_files_are_refused_in_one_line_at_once(tmp_path, name, make, word):
    (tmp_path / "a.tar").write_bytes(make())
    began = time.process_time()
    with pytest.raises(InputError, match=word) as error:
        packed_objects(tmp_path / "a.tar")
    assert "\n" not in str(error.value) and str(error.value).isprintable() and len(str(error.value)) < 500
    assert time.process_time() - began < 1.0
    assert [p.name for p in tmp_path.iterdir()] == ["a.tar"]


def test_large_members_and_many_files_are_refused(tmp_path, monkeypatch):
    (tmp_path / "a.tar").write_bytes(tars.written(*tars.GOOD))
    for limit, value in (("MAX_FILE", 0), ("MAX_FILES", 1), ("MAX_OBJECT", 1024), ("MAX_OBJECTS", 1)):
        with monkeypatch.context() as patch, pytest.raises(InputError, match="at most"):
            patch.setattr(tar, limit, value)
            packed_objects(tmp_path / "a.tar")
    with open(tmp_path / "sparse.tar", "wb") as file:  # half a gibibyte that takes no space
        file.write(tars.raw(b"a/x", b"%011o" % (tar.MAX_FILE + 1)))
        file.truncate(tar.MAX_FILE + 4096)
    with pytest.raises(InputError, match="at most"):
        packed_objects(tmp_path / "sparse.tar")


def test_a_file_that_is_cut_anywhere_or_damaged_is_refused_or_read(tmp_path):
    data, rng = tars.written(*tars.GOOD), Random(0)
    end = len(data.rstrip(b"\0")) // 512 * 512 + 1024  # one block of zeros must be there
    path, began, refused = tmp_path / "a.tar", time.process_time(), 0
    for length in range(0, end, 64):
        path.write_bytes(data[:length])
        with pytest.raises(InputError, match="cut"):
            packed_objects(path)
    for _ in range(1000):
        path.write_bytes(damaged(data, rng))
        try:
            for one in packed_objects(path):
                content(one)
        except InputError:
            refused += 1
    assert 200 < refused < 1000
    assert time.process_time() - began < 20


def test_what_is_said_of_an_object_is_said_of_the_tar_file(tmp_path):
    (tmp_path / "a.tar").write_bytes(tars.written(*tars.GOOD))
    with pytest.raises(ValueError) as error, packed_objects(tmp_path / "a.tar")[1].unpacked() as root:
        raise InputError(root / "transforms.json", "expected another")
    assert str(error.value) == f"{tmp_path}/a.tar/b/transforms.json: expected another"


def test_a_tar_file_that_changes_while_it_is_used_is_refused(tmp_path):
    path = tmp_path / "a.tar"
    path.write_bytes(tars.written(*tars.GOOD))
    found = packed_objects(path)[0]
    path.write_bytes(tars.written(tars.entry("c/word"), *tars.GOOD))
    with pytest.raises(InputError, match="held before"):
        content(found)
