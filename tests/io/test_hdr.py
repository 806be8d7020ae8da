import math

import numpy as np
import OpenEXR
import pytest
import torch

from reli3d.io.files import InputError
from reli3d.io.hdr import (
    HALF_MAX,
    read_environment,
    read_hdr_image,
    rgbe_bytes,
    write_environment,
    write_exr,
    write_hdr,
)


def sky(height: int = 16, seed: int = 0, spread: float = 3.0) -> torch.Tensor:
    """A map over twelve orders of magnitude with black pixels, flat rows and a sun."""
    rng = torch.Generator().manual_seed(seed)
    image = torch.exp(spread * torch.randn(height, 2 * height, 3, generator=rng)).clamp_max(6e4)
    image[2] = 0.25
    image[3, :7] = 0.0
    image[1, 5] = torch.tensor([3e4, 2e4, 0.0])
    return image


def test_float_exr_is_exact(tmp_path):
    assert write_exr(tmp_path / "a.exr", sky(), half=False) == 0
    assert torch.equal(read_hdr_image(tmp_path / "a.exr"), sky())


def test_half_exr_keeps_eleven_bits(tmp_path):
    image = sky().clamp_min(6.2e-5)  # the smallest normal half; below it precision falls
    assert write_exr(tmp_path / "a.exr", image) == 0
    torch.testing.assert_close(read_hdr_image(tmp_path / "a.exr"), image, rtol=2**-11, atol=0)  # half of 2^-10


def test_values_a_file_cannot_hold_are_clamped_and_counted(tmp_path):
    image = sky()
    image[0, 0] = torch.tensor([1e6, math.inf, 1.0])
    assert write_exr(tmp_path / "a.exr", image) == 2
    assert read_hdr_image(tmp_path / "a.exr")[0, 0].tolist() == [HALF_MAX, HALF_MAX, 1.0]
    assert write_exr(tmp_path / "b.exr", image, half=False) == 1  # float holds a million
    assert write_hdr(tmp_path / "c.hdr", image) == 1
    for name in ("b.exr", "c.hdr"):
        assert torch.isfinite(read_hdr_image(tmp_path / name)).all()


@pytest.mark.parametrize("write", [write_exr, write_hdr])
@pytest.mark.parametrize("bad", [math.nan, -1e-6])
def test_nan_and_negative_are_never_written(tmp_path, write, bad):
    image = sky()
    image[4, 4, 1] = bad
    with pytest.raises(ValueError, match="image: expected values >= 0"):
        write(tmp_path / "a", image)
    with pytest.raises(TypeError):
        write(tmp_path / "a", image.double())
    with pytest.raises(ValueError, match="shape"):
        write(tmp_path / "a", image[..., :2])
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("height", [1, 3, 4, 8, 16, 130])
def test_rgbe_keeps_each_pixel_to_a_256th_of_its_largest_channel(tmp_path, height):
    image = sky(height, seed=height) if height > 3 else torch.rand(height, 2 * height, 3)
    write_hdr(tmp_path / "a.hdr", image)
    error = (read_hdr_image(tmp_path / "a.hdr") - image).abs()
    # half a step of the largest channel's mantissa, which is 128 to 255.5 before rounding (above it the step doubles)
    assert bool((error <= image.amax(-1, keepdim=True) / 255).all())


def test_rgbe_edges_of_the_format(tmp_path):
    values = torch.tensor([0.0, 1e-39, 1.0, 255.6 / 256, 0.9999, 1.5e38, 2.0**-100, 65504.0])
    image = values[:, None].expand(8, 16)[..., None].expand(8, 16, 3).contiguous()
    write_hdr(tmp_path / "a.hdr", image)
    back = read_hdr_image(tmp_path / "a.hdr")[:, 0, 0]
    torch.testing.assert_close(back, values, rtol=1 / 256, atol=1e-38)  # 1e-39 lies below the smallest exponent
    assert float(back[0]) == 0.0


def test_runs_of_every_length_survive():
    rng = np.random.default_rng(1)
    for width in (8, 9, 127, 128, 129, 300):
        runs = np.repeat(rng.random(200), rng.integers(1, 140, 200))
        pixels = np.stack([np.resize(runs, (4, width)), np.resize(runs[5:], (4, width)), np.ones((4, width))], -1)
        data = rgbe_bytes(pixels.astype(np.float32))
        assert len(data) < 16 * width + 16 + 64 + 4 * 4 * 3  # flat pixels, leads, header and a count per 128 bytes
        assert_mitsuba_reads_the_same(data, pixels)


def assert_mitsuba_reads_the_same(data: bytes, pixels: np.ndarray) -> None:
    mi = pytest.importorskip("mitsuba")
    mi.set_variant("scalar_rgb")
    stream = mi.MemoryStream()
    stream.write(data)
    stream.seek(0)
    got = np.array(mi.Bitmap(stream).convert(mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.Float32, False))
    np.testing.assert_allclose(got, pixels, atol=pixels.max() / 256)  # as above


def test_real_maps_read_as_mitsuba_reads_them(shared_data):
    mi = pytest.importorskip("mitsuba")
    mi.set_variant("scalar_rgb")
    for path in sorted((shared_data / "hdri").glob("*.hdr"))[:3]:
        image = read_hdr_image(path)
        theirs = np.array(mi.Bitmap(str(path)).convert(mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.Float32, False))
        np.testing.assert_allclose(image.numpy(), theirs, rtol=1e-6)  # the same integers times powers of two


@pytest.mark.parametrize("suffix", ["exr", "hdr"])
def test_mitsuba_sees_the_sun_where_we_put_it(tmp_path, suffix):
    """Here the centre column is +X, right of it +Z; Mitsuba's centre column is +Z, right of it -X."""
    mi = pytest.importorskip("mitsuba")
    mi.set_variant("scalar_rgb")
    height = 32
    for row, column in ((16, 32), (16, 48), (4, 10), (27, 60)):
        image = torch.full((height, 2 * height, 3), 0.01)
        image[row - 1 : row + 2, column - 1 : column + 2] = 100.0
        write_environment(tmp_path / f"sun.{suffix}", image)
        phi = 2 * math.pi * (column + 0.5) / (2 * height) - math.pi
        theta = math.pi * (row + 0.5) / height
        d = [math.cos(phi) * math.sin(theta), math.cos(theta), math.sin(phi) * math.sin(theta)]
        light = mi.load_dict(
            {
                "type": "envmap",
                "filename": str(tmp_path / f"sun.{suffix}"),
                "to_world": mi.ScalarTransform4f().rotate([0, 1, 0], 90),
            }
        )
        it = mi.SurfaceInteraction3f()
        it.wi = mi.Vector3f([-v for v in d])
        assert abs(float(light.eval(it)[0]) - 100.0) < 0.1  # Mitsuba's texels lie up to half a texel off: hence 3 x 3
        it.wi = mi.Vector3f(d)
        assert float(light.eval(it)[0]) < 0.1


def test_an_environment_comes_back(tmp_path):
    image = sky(8)
    assert write_environment(tmp_path / "a.exr", image) == 0
    torch.testing.assert_close(read_environment(tmp_path / "a.exr"), image, rtol=2**-11, atol=2**-25)  # half floats
    columns = torch.arange(6.0)[None, :, None].expand(3, 6, 3).contiguous()
    write_exr(tmp_path / "odd.exr", columns, half=False)
    assert torch.equal(read_environment(tmp_path / "odd.exr"), columns)


def test_an_environment_is_refused_by_name_and_shape(tmp_path):
    for path, image, said in (
        ("a.png", sky(), "path: expected"),
        ("a.exr", sky()[:8], "radiance: expected shape"),
    ):
        with pytest.raises(ValueError, match=said):
            write_environment(tmp_path / path, image)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "options, dtype",
    [
        ({"compression": OpenEXR.PIZ_COMPRESSION}, np.float32),
        ({"compression": OpenEXR.NO_COMPRESSION}, np.float16),
        ({"compression": OpenEXR.RLE_COMPRESSION}, np.float32),
        ({"compression": OpenEXR.ZIPS_COMPRESSION}, np.float16),
    ],
)
def test_exr_of_other_writers_reads(tmp_path, options, dtype):
    planes = {c: np.random.default_rng(0).random((40, 80)).astype(dtype) for c in ("A", "B", "G", "R", "Z")}
    window = (np.array([3, 7], np.int32), np.array([82, 46], np.int32))
    header = {"type": OpenEXR.scanlineimage, "dataWindow": window, **options}
    with OpenEXR.File(header, dict(planes)) as file:
        file.write(str(tmp_path / "a.exr"))
    got = read_hdr_image(tmp_path / "a.exr")
    assert np.array_equal(got.numpy(), np.stack([planes[c] for c in "RGB"], -1).astype(np.float32))


def test_grey_and_cleaned_pixels(tmp_path):
    grey = np.ones((8, 16), np.float32)
    grey[0, :3] = (np.inf, -2.0, 5e5)
    with OpenEXR.File({"type": OpenEXR.scanlineimage}, {"Y": grey}) as file:
        file.write(str(tmp_path / "a.exr"))
    notes: list[str] = []
    image = read_hdr_image(tmp_path / "a.exr", notes=notes)
    assert image[0, :3, 2].tolist() == [HALF_MAX, 0.0, 5e5]
    assert notes == ["a.exr: 3 infinite values set to 65504, 3 negative to 0"]
    grey[0, 0] = np.nan
    with OpenEXR.File({"type": OpenEXR.scanlineimage}, {"Y": grey}) as file:
        file.write(str(tmp_path / "a.exr"))
    with pytest.raises(InputError, match="NaN at 1 pixels"):
        read_hdr_image(tmp_path / "a.exr")


def test_exposure_of_the_header_is_divided_out(tmp_path):
    data = rgbe_bytes(np.ones((4, 8, 3), np.float32)).replace(b"\n\n", b"\nEXPOSURE= 2.0\nEXPOSURE=4\n\n", 1)
    (tmp_path / "a.hdr").write_bytes(data)
    assert float(read_hdr_image(tmp_path / "a.hdr").max()) == 0.125


def test_writing_to_a_place_that_is_not_there_is_an_oserror(tmp_path):
    for write in (write_exr, write_hdr):
        with pytest.raises(OSError):
            write(tmp_path / "none" / "a", sky())
