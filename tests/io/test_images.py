import math
import os
import tracemalloc

import cv2
import numpy as np
import OpenEXR
import pytest
import torch
from PIL import Image

from reli3d.errors import InputError, printable, shown
from reli3d.io.files import read_bytes, write_bytes
from reli3d.io.hdr import read_hdr_image
from reli3d.io.images import color_of, png_bytes, read_image, write_image, write_png

NOISE = np.random.default_rng(3).integers(0, 256, (9, 14, 4), np.uint8)
SIZE = (40, 24)  # width, height
SHADES = np.random.default_rng(1).integers(0, 256, (SIZE[1], SIZE[0], 4), np.uint8)
DEEP = SHADES.astype(np.uint16) * 256 + 3
PALETTE = Image.fromarray(SHADES[..., :3]).quantize(16)


def saved(tmp_path, image: Image.Image, name: str, **options):
    image.save(tmp_path / name, **options)
    return tmp_path / name


def deep_png(channels):
    """16-bit PNG by OpenCV: Pillow writes none but gray."""
    return lambda path: cv2.imwrite(str(path), cv2.cvtColor(DEEP, channels))


def saver(mode, ending=".png", **options):
    return lambda path: Image.fromarray(SHADES).convert(mode).save(path.with_suffix(ending), **options)


def color(v):
    return v[..., :3]


def gray(k):
    return lambda v: np.repeat(v[..., k : k + 1], 3, -1)


# kind of image: how a file of it is written, expected color, tolerance [of 255]
ACCEPTED = {
    "8-bit color": (saver("RGB"), color, 0),
    "8-bit color, TIFF": (saver("RGB", ".tif"), color, 0),
    "8-bit color with alpha": (saver("RGBA"), color, 0),
    "8-bit color with alpha, WebP": (saver("RGBA", ".webp", lossless=True, exact=True), color, 0),
    "8-bit color with alpha, TIFF": (saver("RGBA", ".tif"), color, 0),
    "8-bit gray": (lambda p: Image.fromarray(SHADES[..., 0]).save(p), gray(0), 0),
    "1-bit": (lambda p: Image.fromarray(SHADES[..., 0] > 99).save(p), lambda v: (gray(0)(v) > 99) * 255, 0),
    "16-bit gray": (lambda p: Image.fromarray(DEEP[..., 0]).save(p), lambda v: DEEP[..., :1] / 257.0, 0),
    "16-bit color": (deep_png(cv2.COLOR_RGBA2BGR), color, 1),  # the low byte is dropped
    "16-bit color with alpha": (deep_png(cv2.COLOR_RGBA2BGRA), color, 1),
    "palette": (lambda p: PALETTE.save(p), lambda v: np.array(PALETTE.convert("RGB")), 0),
    # Pillow's plain conversion to ink and back: each of the two rounds to 8 bits
    "CMYK": (lambda p: Image.fromarray(color(SHADES)).convert("CMYK").save(p.with_suffix(".tif")), color, 2),
}
REFUSED = {
    "32-bit": lambda p: Image.fromarray(SHADES[..., 0].astype(np.float32)).save(p.with_suffix(".tif")),
    "GIF": saver("RGB", ".gif"),
    "AVIF": saver("RGB", ".avif"),
    "several frames": saver("RGBA", ".tif", save_all=True, append_images=[Image.fromarray(SHADES)]),
}


@pytest.mark.parametrize("name", ACCEPTED)
def test_accepted_images_are_read_as_stored(tmp_path, name):
    write, expected, tolerance = ACCEPTED[name]
    write(tmp_path / "a.png")
    (path,) = tmp_path.iterdir()
    values, alpha = read_image(path)
    exact = torch.from_numpy(np.ascontiguousarray(expected(SHADES))).float().expand(SIZE[1], SIZE[0], 3)
    assert float((values * 255 - exact).abs().max()) <= tolerance + 1e-4  # a few ulp of float32 at 255
    assert (alpha is not None) == ("alpha" in name)
    if alpha is not None:
        assert torch.equal((alpha * 255).round().byte(), torch.from_numpy(SHADES[..., 3].copy()))


@pytest.mark.parametrize("name", REFUSED)
def test_refused_images_end_in_one_line(tmp_path, name):
    REFUSED[name](tmp_path / "a.png")
    (path,) = tmp_path.iterdir()
    with pytest.raises(InputError, match=r"a\.\w+: expected .*; "):
        read_image(path)


def test_a_transparent_color_of_a_palette_is_alpha_and_cmyk_of_a_jpeg_color(tmp_path):
    flat = Image.fromarray(np.repeat(NOISE[:1, :5, :3], 7, 0)).quantize(8)
    _, alpha = read_image(saved(tmp_path, flat, "key.png", transparency=flat.getpixel((0, 0))))
    assert float(alpha[0, 0]) == 0.0 and float(alpha.max()) == 1.0
    cmyk, _ = read_image(saved(tmp_path, Image.new("CMYK", (16, 16), (0, 255, 255, 0)), "ink.jpg", quality=95))
    assert (cmyk[8, 8] - torch.tensor([1.0, 0.0, 0.0])).abs().max() < 0.03  # JPEG of a flat color: a few 8-bit steps


def test_the_size_limit_holds_before_decoding(tmp_path):
    path = saved(tmp_path, Image.new("1", (9000, 9000)), "large.png")  # 81 MP in 10 kB: below Pillow's own limit
    with pytest.raises(InputError, match="67108864 pixels, got 9000 x 9000"):
        read_image(path)


def test_color_takes_no_memory_for_alpha():
    """Found by the campaign: 33 MP with alpha took more than 1 GiB."""
    bitmap = Image.fromarray(np.full((1000, 1000, 4), 255, np.uint8))
    tracemalloc.start()
    try:
        assert bool((color_of(bitmap) == 1).all())
        assert tracemalloc.get_traced_memory()[1] < 24e6  # 12 of the result, 4 or 8 of the pixels as stored
    finally:
        tracemalloc.stop()


def test_png_round_trip(tmp_path):
    for pixels in (NOISE, NOISE[:1, :1], NOISE[:1, :7], NOISE[:5, :1, :3]):
        write_png(tmp_path / "a.png", pixels)
        assert np.array_equal(np.asarray(Image.open(tmp_path / "a.png")), pixels)
    values = torch.tensor([[[-1.0, 0.0, 0.4999], [0.5001, 1.0, 7.0]]]) / torch.tensor([1.0, 1.0, 1.0])
    write_png(tmp_path / "b.png", values)  # clamped, and rounded to the nearest of 255 steps
    assert np.asarray(Image.open(tmp_path / "b.png")).tolist() == [[[0, 0, 127], [128, 255, 255]]]


def test_png_refuses():
    for pixels in (*map(torch.zeros, ((4, 4, 2), (0, 4, 3), (4,))), torch.full((4, 4, 3), math.nan)):
        with pytest.raises(ValueError, match="pixels: expected"):
            png_bytes(pixels)
    with pytest.raises(TypeError, match="pixels: expected"):
        png_bytes(torch.zeros(4, 4, 3).long())


def srgb(linear: np.ndarray) -> np.ndarray:
    """IEC 61966-2-1."""
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 1e-9) ** (1 / 2.4) - 0.055)


def test_a_linear_image_is_encoded_by_its_suffix(tmp_path):
    image = torch.rand(6, 9, 4, generator=torch.Generator().manual_seed(0)) * 1.5
    alpha = image[..., 3] = image[..., 3].clamp(0.1, 1.0)
    alpha[0, 0] = image[0, 0] = 0.0
    for linear in (image[..., :3], image[..., 0]):
        write_image(tmp_path / "a.png", linear)
        got = np.asarray(Image.open(tmp_path / "a.png"))
        np.testing.assert_allclose(got, 255 * srgb(linear.numpy()).clip(0, 1), atol=0.5 + 1e-3)  # 8 bits
    write_image(tmp_path / "a.PNG", image)
    got = np.asarray(Image.open(tmp_path / "a.PNG"))
    unmultiplied = image[..., :3] / alpha[..., None].clamp(min=1e-6)
    np.testing.assert_allclose(got[..., :3], 255 * srgb(unmultiplied.numpy()).clip(0, 1), atol=0.5 + 1e-3)
    np.testing.assert_allclose(got[..., 3], 255 * alpha.numpy(), atol=0.5 + 1e-3)
    for channels, name in ((image, "RGBA"), (image[..., :3], "RGB"), (image[..., 0], "Y")):
        write_image(tmp_path / "a.exr", channels)
        with OpenEXR.File(str(tmp_path / "a.exr")) as file:
            assert np.array_equal(file.channels()[name].pixels, channels.numpy())
    write_image(tmp_path / "a.hdr", image[..., :3])
    largest = image[..., :3].amax(-1, keepdim=True)
    assert bool(((read_hdr_image(tmp_path / "a.hdr") - image[..., :3]).abs() <= largest / 255).all())  # RGBE's step


@pytest.mark.parametrize(
    "name, image, error",
    [
        ("a.jpg", torch.ones(4, 4, 3), "path: expected"),
        ("a.hdr", torch.ones(4, 4, 4), "image: expected shape"),
        ("a.exr", torch.ones(0, 4, 2), "image: expected shape"),
        ("a.png", torch.full((4, 4, 3), math.nan), "image: expected finite"),
        ("a.exr", torch.full((4, 4, 3), math.inf), "image: expected finite"),
    ],
)
def test_invalid_linear_images_are_not_written(tmp_path, name, image, error):
    with pytest.raises(ValueError, match=error):
        write_image(tmp_path / name, image)
    with pytest.raises(TypeError, match="image: expected a float32 tensor, as Render.rgba, got ndarray"):
        write_image(tmp_path / "a.png", NOISE)
    with pytest.raises(FileNotFoundError, match="the folder does not exist: '.*none'"):
        write_image(tmp_path / "none" / "a.png", torch.ones(4, 4, 3))
    assert not list(tmp_path.iterdir())


def test_a_failed_write_leaves_the_old_file_and_nothing_else(tmp_path, monkeypatch):
    write_png(tmp_path / "a.png", NOISE)
    old = (tmp_path / "a.png").read_bytes()

    def full_disk(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "replace", full_disk)
    with pytest.raises(OSError, match="No space"):
        write_png(tmp_path / "a.png", NOISE[::-1])
    assert [p.name for p in tmp_path.iterdir()] == ["a.png"]
    assert (tmp_path / "a.png").read_bytes() == old
    with pytest.raises(OSError):
        write_bytes(tmp_path / "no folder" / "a.png", b"x")


def test_files_are_written_with_the_usual_permissions_and_any_name_and_read_within_the_limit(tmp_path):
    write_bytes(tmp_path / "a", b"12345")
    (tmp_path / "b").write_bytes(b"x")
    assert (tmp_path / "a").stat().st_mode == (tmp_path / "b").stat().st_mode
    assert read_bytes(tmp_path / "a", 5) == b"12345"
    for path, limit in ((tmp_path / "a", 4), (tmp_path, 9), (tmp_path / "none", 9), ("a\0b", 9), ("/dev/null", 9)):
        with pytest.raises(InputError):
            read_bytes(path, limit)
    for name in ("n" * 251 + ".png", "n." + "s" * 253):
        write_bytes(tmp_path / name, b"data")
        assert (tmp_path / name).read_bytes() == b"data"


def test_messages_are_one_printable_line():
    assert str(InputError("a\nb", "c\x1b[31m\ud800 d")) == "a\\nb: c\\x1b[31m\\ud800 d"
    assert printable("naïve\t") == "naïve\\t"
    assert len(shown("x" * 999)) <= 60
    nested: list = []
    nested.append(nested)
    assert shown(nested) == "[[...]]"
