"""PNG files, read back by Pillow, which checks every sum in them."""

import io
import zlib

import numpy as np
import pytest
import torch
from PIL import Image

from reli3d.io.png import encode


def smooth(height, width, channels, noise):
    rng = np.random.default_rng(height * width + channels)
    y, x = np.mgrid[:height, :width] / 40.0
    waves = np.stack([np.sin((k + 1) * x + y) * np.cos(y - k * x) for k in range(channels)], -1)
    return (127.5 + 100.0 * waves + noise * rng.standard_normal(waves.shape)).clip(0, 255).astype(np.uint8)


@pytest.mark.parametrize("channels", [1, 3, 4])
@pytest.mark.parametrize("size", [(1, 1), (1, 7), (7, 1), (3, 5), (64, 48), (257, 130)])
def test_pillow_reads_the_pixels_back(size, channels):
    for noise in (0.0, 3.0, 300.0):
        pixels = smooth(*size, channels, noise)
        pixels = pixels[..., 0] if channels == 1 else pixels
        data = encode(pixels)
        with Image.open(io.BytesIO(data)) as image:
            image.verify()
        with Image.open(io.BytesIO(data)) as image:
            assert image.format == "PNG" and image.mode == {1: "L", 3: "RGB", 4: "RGBA"}[channels]
            assert np.array_equal(np.asarray(image), pixels)


def predicted():
    """Rows of 90 pixels: noise, the row above, a slope, the mean of left and above, black; and smooth ones."""
    rng, rows = np.random.default_rng(1), []
    for _ in range(12):
        rows.append(rng.integers(0, 256, (90, 3)))
        rows.append(rows[-1] + rng.integers(0, 2, (90, 3)))
        rows.append(rng.integers(0, 256, 3) + 3 * np.arange(90)[:, None])
        mean = [rng.integers(0, 256, 3)]
        for above in rows[-1][1:]:
            mean.append((mean[-1] % 256 + above % 256) // 2)
        rows += [np.stack(mean), np.zeros((90, 3), int)]
    return np.concatenate([np.stack(rows).astype(np.uint8), smooth(60, 90, 3, 0.0)])


def test_every_filter_is_used_and_files_are_as_small_as_pillow_s():
    pixels = predicted()
    data = encode(pixels)
    start = data.index(b"IDAT") + 4
    size = int.from_bytes(data[start - 8 : start - 4], "big")
    rows = np.frombuffer(zlib.decompress(data[start : start + size]), np.uint8).reshape(len(pixels), -1)
    assert set(rows[:, 0]) == {0, 1, 2, 3, 4}
    assert np.array_equal(np.asarray(Image.open(io.BytesIO(data))), pixels)
    pixels, peer = smooth(512, 512, 3, 2.0), io.BytesIO()
    Image.fromarray(pixels).save(peer, "PNG", compress_level=1, compress_type=zlib.Z_RLE)
    # the same filters and the same compression, begun again for each of eight strips
    assert len(encode(pixels)) < 1.005 * len(peer.getvalue())


def test_the_file_is_the_same_for_any_number_of_threads_and_the_pixels_may_be_read_only():
    pixels = smooth(200, 100, 3, 5.0)
    pixels.flags.writeable = False
    data, threads = encode(pixels), torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        assert encode(np.asfortranarray(pixels)) == data
    finally:
        torch.set_num_threads(threads)


def test_what_is_no_picture_is_refused():
    with pytest.raises(TypeError, match="pixels: expected uint8, got float32"):
        encode(np.zeros((2, 2, 3), np.float32))
    for shape in ((2, 2, 2), (0, 2), (4,)):
        with pytest.raises(ValueError, match="pixels: expected shape"):
            encode(np.zeros(shape, np.uint8))
