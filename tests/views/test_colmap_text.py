"""Text models as COLMAP, people and other programs write them, and folders with several models."""

import shutil

import numpy as np
import pytest
from PIL import Image

from reli3d.errors import InputError
from reli3d.views.folder import load_views
from tests.support import hostile
from tests.support.colmap_model import write_binary, write_text

NAMES = ("0.png", "1.png", "2.png")


@pytest.fixture
def model(tmp_path):
    """A folder of three images, and the lines of its images.txt: poses with points in between."""
    _, images = hostile.colmap(tmp_path)
    return tmp_path, images.splitlines()[1:]


def write(folder, lines, newline="\n", bom=b""):
    (folder / "sparse/0/images.txt").write_bytes(bom + newline.join([*lines, ""]).encode())


@pytest.mark.parametrize(
    "change",
    {
        "points": lambda lines: lines,
        "empty lines for points": lambda lines: [line for pose in lines[::2] for line in (pose, "")],
        "no lines of points": lambda lines: lines[::2],
        "one without points": lambda lines: [lines[0], *lines[2:]],
        "blank lines": lambda lines: ["", *[line for pose in lines for line in (pose, "", "")]],
        "comments between": lambda lines: [line for pose in lines for line in ("# image", pose, "  # points")],
        "no last points": lambda lines: lines[:-1],
        "spaces around": lambda lines: [f"  {line} \t" for line in lines],
    }.items(),
    ids=lambda item: item[0],
)
@pytest.mark.parametrize("newline, bom", [("\n", b""), ("\r\n", b""), ("\n", b"\xef\xbb\xbf")])
def test_every_image_is_read(model, change, newline, bom):
    folder, lines = model
    expected = load_views(folder)
    write(folder, change[1](lines), newline, bom)
    cameras = (folder / "sparse/0/cameras.txt").read_text()
    (folder / "sparse/0/cameras.txt").write_bytes(bom + cameras.replace("\n", newline).encode())
    views = load_views(folder)
    assert views.names == NAMES and views.notes == expected.notes
    assert bool((views.c2w == expected.c2w).all())


def test_names_with_spaces_and_digits(model):
    folder, lines = model
    names = ("a b c.png", "12 3 4 5 6.png", "7.png")
    for old, new in zip(NAMES, names):
        (folder / "images" / old).rename(folder / "images" / new)
    write(folder, [line.replace(old, new) for line, old, new in zip(lines[::2], NAMES, names)])
    assert set(load_views(folder).names) == set(names)


def copied(folder, place, lines):
    (folder / place).mkdir(parents=True)
    shutil.copy(folder / "sparse/0/cameras.txt", folder / place)
    (folder / place / "images.txt").write_text("\n".join(lines) + "\n")


@pytest.mark.parametrize("place", ["sparse/1", "sparse/10", "colmap/sparse/2"])
def test_the_model_with_most_images_is_used(model, place):
    folder, lines = model
    copied(folder, place, lines)
    write(folder, lines[:2])
    views = load_views(folder)
    assert views.names == NAMES
    assert any(f"sparse/0/images.txt 1, {place}/images.txt 3: {place}/images.txt is used" in n for n in views.notes)


def test_of_text_and_binary_the_larger_is_used(tmp_path):
    write_text(tmp_path / "sparse/0")
    for name in ("b 1.png", "ü/a.png", "c.png", "d.png"):
        (tmp_path / "images" / name).parent.mkdir(parents=True, exist_ok=True)
        pixels = np.zeros((24, 32, 4), np.uint8)
        pixels[4:20, 4:28] = 255
        Image.fromarray(pixels).save(tmp_path / "images" / name)
    text = load_views(tmp_path)
    write_binary(tmp_path / "binary")
    for name in ("cameras.bin", "images.bin"):
        shutil.copy(tmp_path / "binary" / name, tmp_path / "sparse/0")
    both = load_views(tmp_path)
    assert any("sparse/0/images.txt is used" in n for n in both.notes)
    lines = (tmp_path / "sparse/0/images.txt").read_text().splitlines()
    (tmp_path / "sparse/0/images.txt").write_text("\n".join(lines[:-2]) + "\n")
    larger = load_views(tmp_path)
    assert larger.names == both.names == text.names and len(text) == 4
    assert any("images.txt 3, sparse/0/images.bin 4: sparse/0/images.bin is used" in n for n in larger.notes)


def test_images_that_the_model_does_not_list_are_counted(model):
    folder, lines = model
    write(folder, lines[:4])
    assert "the model lists 2 of the 3 images in the folder" in load_views(folder).notes


def test_listed_images_that_are_missing_are_left_out_and_named(model):
    folder, _ = model
    (folder / "images/1.png").unlink()
    views = load_views(folder)
    assert views.names == ("0.png", "2.png")
    assert "of the 3 images that the model lists 1 are missing in the folder: '1.png'" in views.notes
    shutil.rmtree(folder / "images")
    with pytest.raises(InputError, match="expected images in .*, got '0.png' which does not exist"):
        load_views(folder)


def test_names_relative_to_the_folder_itself(model):
    folder, lines = model
    write(folder, [line.replace(name, f"images/{name}") for line, name in zip(lines[::2], NAMES)])
    assert load_views(folder).names == tuple(f"images/{name}" for name in NAMES)


def test_an_image_that_is_listed_twice_is_refused(model):
    folder, lines = model
    write(folder, [*lines, *lines[:2]])
    with pytest.raises(InputError, match=r"NAME: expected each image once, got '0.png' 2 times"):
        load_views(folder)


@pytest.mark.parametrize("name", ["./1.png", "1.PNG"])
def test_another_name_of_a_listed_image_is_refused(model, name):
    folder, lines = model
    write(folder, [line.replace(" 0.png", f" {name}") for line in lines])
    with pytest.raises(InputError, match="pose: expected one for each image, got another for '1.png'"):
        load_views(folder)
