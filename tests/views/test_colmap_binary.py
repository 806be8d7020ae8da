"""COLMAP's binary models, against a model that COLMAP wrote in both forms."""

import os

import numpy as np
import pytest
import torch
from PIL import Image

from reli3d.errors import InputError
from reli3d.views.folder import load_views
from tests.support import colmap_model
from tests.support.colmap_model import CAMERAS_BIN, IMAGES_BIN

NAMES = ("b 1.png", "c.png", "d.png", "ü/a.png")


def photographs(folder):
    for name in NAMES:
        pixels = np.zeros((24, 32, 4), np.uint8)
        pixels[6:18, 8:24] = (200, 50, 20, 255)
        (folder / "images" / name).parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(pixels).save(folder / "images" / name)
    return folder


@pytest.mark.parametrize("name", ["cameras.bin", "images.bin"])
def test_a_pipe_is_refused_and_not_waited_for(tmp_path, name):
    model = photographs(tmp_path) / "sparse/0"
    colmap_model.write_binary(model)
    (model / name).unlink()
    os.mkfifo(model / name)
    with pytest.raises(InputError, match="expected a regular file"):
        load_views(tmp_path)


def test_text_and_binary_of_one_model_are_the_same(tmp_path):
    for kind in ("text", "binary"):
        photographs(tmp_path / kind)
    colmap_model.write_text(tmp_path / "text/sparse/0")
    colmap_model.write_binary(tmp_path / "binary/sparse/0")
    a, b = load_views(tmp_path / "text"), load_views(tmp_path / "binary")
    assert a.names == b.names == NAMES
    assert torch.equal(a.c2w, b.c2w) and torch.equal(a.intrinsics, b.intrinsics)  # 17 digits in the text
    torch.testing.assert_close(b.intrinsics[1], torch.tensor([50.5, 51.25, 15.0, 12.5]))
    assert [n.split(": ", 1)[-1].split("line")[0] for n in a.notes if "distortion" not in n] == [
        n.split(": ", 1)[-1] for n in b.notes if "distortion" not in n
    ]
    colmap_model.write_binary(tmp_path / "text/sparse/1")
    # next to the text files: not read
    (tmp_path / "text/sparse/1/images.bin").rename(tmp_path / "text/sparse/0/images.bin")
    assert load_views(tmp_path / "text").names == NAMES


def refusal(folder, **files) -> str:
    colmap_model.write_binary(photographs(folder) / "sparse/0", **files)
    with pytest.raises(InputError) as caught:
        load_views(folder)
    return str(caught.value)


def test_a_file_that_ends_early_is_refused_wherever_it_ends(tmp_path):
    for k in range(0, len(IMAGES_BIN), 9):
        assert "images.bin" in refusal(tmp_path / f"i{k}", images=IMAGES_BIN[:k])
    for k in range(0, len(CAMERAS_BIN), 9):
        assert "cameras.bin" in refusal(tmp_path / f"c{k}", cameras=CAMERAS_BIN[:k])


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
def test_wrong_entries_are_named(tmp_path, words, files):
    text = refusal(tmp_path / "object", **files)
    assert words in text and text.isprintable()
