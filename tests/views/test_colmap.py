"""COLMAP models: as COLMAP wrote one in both forms, as others write them, several in a folder, and broken ones."""

import os
import shutil

import numpy as np
import pytest
import torch
from PIL import Image

from reli3d.errors import InputError
from reli3d.views.folder import load_views
from tests.support import hostile
from tests.support.colmap_model import CAMERAS_BIN, IMAGES_BIN, write_binary, write_text

NAMES = ("0.png", "1.png", "2.png")
STORED = ("b 1.png", "c.png", "d.png", "ü/a.png")  # of the model that COLMAP wrote


def photographs(folder):
    for name in STORED:
        pixels = np.zeros((24, 32, 4), np.uint8)
        pixels[6:18, 8:24] = (200, 50, 20, 255)
        (folder / "images" / name).parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(pixels).save(folder / "images" / name)
    return folder


def test_text_and_binary_of_one_model_are_the_same_and_the_larger_is_used(tmp_path):
    write_text(photographs(tmp_path / "text") / "sparse/0")
    write_binary(photographs(tmp_path / "binary") / "sparse/0")
    a, b = load_views(tmp_path / "text"), load_views(tmp_path / "binary")
    assert a.names == b.names == STORED
    assert torch.equal(a.c2w, b.c2w) and torch.equal(a.intrinsics, b.intrinsics)  # 17 digits in the text
    torch.testing.assert_close(b.intrinsics[1], torch.tensor([50.5, 51.25, 15.0, 12.5]))
    assert [n.split(": ", 1)[-1] for n in a.notes if "distortion" not in n] == [
        n.split(": ", 1)[-1] for n in b.notes if "distortion" not in n
    ]
    model = tmp_path / "text/sparse/0"
    shutil.copy(tmp_path / "binary/sparse/0/images.bin", model)  # next to the text files: not read without cameras.bin
    assert load_views(tmp_path / "text").notes == a.notes
    shutil.copy(tmp_path / "binary/sparse/0/cameras.bin", model)
    assert any("sparse/0/images.txt is used" in n for n in load_views(tmp_path / "text").notes)
    lines = (model / "images.txt").read_text().splitlines()
    (model / "images.txt").write_text("\n".join(lines[:-2]) + "\n")
    larger = load_views(tmp_path / "text")
    assert larger.names == STORED
    assert any("images.txt 3, sparse/0/images.bin 4: sparse/0/images.bin is used" in n for n in larger.notes)


def refusal(folder, **files) -> str:
    write_binary(photographs(folder) / "sparse/0", **files)
    with pytest.raises(InputError) as caught:
        load_views(folder)
    return str(caught.value)


def test_a_binary_file_that_ends_early_is_refused_wherever_it_ends(tmp_path):
    for name, data in (("images", IMAGES_BIN), ("cameras", CAMERAS_BIN)):
        for k in range(0, len(data), 9):
            assert f"{name}.bin" in refusal(tmp_path / f"{name}{k}", **{name: data[:k]})


def put(data: bytes, at: int, new: bytes) -> bytes:
    return data[:at] + new + data[at + len(new) :]


@pytest.mark.parametrize(
    "words, files",
    [
        ("cut off", {"cameras": put(CAMERAS_BIN, 0, b"\xff" * 8)}),  # 2^64 cameras
        ("cut off", {"images": put(IMAGES_BIN, 0, b"\xff" * 8)}),
        ("got 'OPENCV_FISHEYE'", {"cameras": put(CAMERAS_BIN, 12, b"\5")}),
        ("got 'number 77'", {"cameras": put(CAMERAS_BIN, 12, b"\x4d")}),
        ("got 'number -1'", {"cameras": put(CAMERAS_BIN, 12, b"\xff" * 4)}),
        ("positive size", {"cameras": put(CAMERAS_BIN, 16, b"\0" * 8)}),
        ("positive size", {"cameras": put(CAMERAS_BIN, 16, b"\xff" * 8)}),
        ("finite number", {"cameras": put(CAMERAS_BIN, 32, np.array(np.nan, "<f8").tobytes())}),
        ("twice", {"cameras": put(CAMERAS_BIN, 72, b"\1")}),
        ("QVEC", {"images": put(IMAGES_BIN, 12, np.array(7.0, "<f8").tobytes())}),
        ("CAMERA_ID", {"images": put(IMAGES_BIN, 68, b"\x09")}),
        ("UTF-8", {"images": put(IMAGES_BIN, 72, b"\xff")}),
        ("leads out", {"images": put(IMAGES_BIN, 72, b"../b.p")}),
        ("cut off", {"images": put(IMAGES_BIN, 80, b"\xff" * 8)}),  # 2^64 points
        ("at least one camera", {"cameras": b"\0" * 8}),
        ("at least one image", {"images": b"\0" * 8}),
    ],
)
def test_wrong_entries_of_a_binary_file_are_named(tmp_path, words, files):
    text = refusal(tmp_path / "object", **files)
    assert words in text and text.isprintable()


@pytest.mark.parametrize("name", ["cameras.bin", "images.bin"])
def test_a_pipe_is_refused_and_not_waited_for(tmp_path, name):
    model = photographs(tmp_path) / "sparse/0"
    write_binary(model)
    (model / name).unlink()
    os.mkfifo(model / name)
    with pytest.raises(InputError, match="expected a regular file"):
        load_views(tmp_path)


@pytest.fixture
def model(tmp_path):
    """A folder of three images, and the lines of its images.txt: poses with points in between."""
    _, images = hostile.colmap(tmp_path)
    return tmp_path, images.splitlines()[1:]


def write(folder, lines):
    (folder / "sparse/0/images.txt").write_text("\n".join([*lines, ""]))


FORMS = {
    "one without points": lambda lines: [lines[0], *lines[2:]],
    "blank lines": lambda lines: ["", *[line for pose in lines for line in (pose, "", "")]],
    "comments between": lambda lines: [line for pose in lines for line in ("# image", pose, "  # points")],
    "no last points": lambda lines: lines[:-1],
    "spaces around": lambda lines: [f"  {line} \t" for line in lines],
}


@pytest.mark.parametrize("form", FORMS)
def test_every_image_is_read(model, form):
    """More forms, line ends and byte order marks are among the random models of ``tests.support.known``."""
    folder, lines = model
    expected = load_views(folder)
    write(folder, FORMS[form](lines))
    views = load_views(folder)
    assert views.names == NAMES and views.notes == expected.notes
    assert bool((views.c2w == expected.c2w).all())


def test_names_have_spaces_and_digits_and_may_be_relative_to_the_folder_itself(model):
    folder, lines = model
    write(folder, [line.replace(name, f"images/{name}") for line, name in zip(lines[::2], NAMES)])
    assert load_views(folder).names == tuple(f"images/{name}" for name in NAMES)
    names = ("a b c.png", "12 3 4 5 6.png", "7.png")
    for old, new in zip(NAMES, names):
        (folder / "images" / old).rename(folder / "images" / new)
    write(folder, [line.replace(old, new) for line, old, new in zip(lines[::2], NAMES, names)])
    assert set(load_views(folder).names) == set(names)


@pytest.mark.parametrize("place", ["sparse/1", "sparse/10", "colmap/sparse/2"])
def test_the_model_with_most_images_is_used(model, place):
    folder, lines = model
    (folder / place).mkdir(parents=True)
    shutil.copy(folder / "sparse/0/cameras.txt", folder / place)
    (folder / place / "images.txt").write_text("\n".join(lines) + "\n")
    write(folder, lines[:2])
    views = load_views(folder)
    assert views.names == NAMES
    assert any(f"sparse/0/images.txt 1, {place}/images.txt 3: {place}/images.txt is used" in n for n in views.notes)


def test_images_that_are_not_listed_or_missing_are_counted(model):
    folder, lines = model
    write(folder, lines[:4])
    assert "the model lists 2 of the 3 images in the folder" in load_views(folder).notes
    write(folder, lines)
    (folder / "images/1.png").unlink()
    views = load_views(folder)
    assert views.names == ("0.png", "2.png")
    assert "of the 3 images that the model lists 1 are missing in the folder: '1.png'" in views.notes
    shutil.rmtree(folder / "images")
    with pytest.raises(InputError, match="expected images in .*, got '0.png' which does not exist"):
        load_views(folder)


def test_an_image_that_is_listed_twice_is_refused(model):
    folder, lines = model
    write(folder, [*lines, *lines[:2]])
    with pytest.raises(InputError, match=r"NAME: expected each image once, got '0.png' 2 times"):
        load_views(folder)
    for name in ("./1.png", "1.PNG"):  # another name of a listed image
        write(folder, [line.replace(" 0.png", f" {name}") for line in lines])
        with pytest.raises(InputError, match="pose: expected one for each image, got another for '1.png'"):
            load_views(folder)
