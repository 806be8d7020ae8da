import math
import struct

import numpy as np
import OpenEXR
import pytest
import torch

from reli3d.errors import InputError
from reli3d.io.hdr import HALF_MAX, read_environment, read_hdr_image, write_environment, write_exr, write_hdr
from reli3d.io.rgbe import rgbe_bytes
from reli3d.render.environment import Environment


def sky(height: int = 16, seed: int = 0, spread: float = 3.0) -> torch.Tensor:
    """A map over twelve orders of magnitude with black pixels, flat rows and a sun."""
    rng = torch.Generator().manual_seed(seed)
    image = torch.exp(spread * torch.randn(height, 2 * height, 3, generator=rng)).clamp_max(6e4)
    image[2] = 0.25
    image[3, :7] = 0.0
    image[1, 5] = torch.tensor([3e4, 2e4, 0.0])
    return image


def test_exr_keeps_float_exactly_and_half_to_eleven_bits(tmp_path):
    assert write_exr(tmp_path / "a.exr", sky(), half=False) == 0
    assert torch.equal(read_hdr_image(tmp_path / "a.exr"), sky())
    image = sky().clamp_min(6.2e-5)  # the smallest normal half; below it precision falls
    assert write_environment(tmp_path / "b.exr", Environment(image)) == 0
    torch.testing.assert_close(read_environment(tmp_path / "b.exr").radiance, image, rtol=2**-11, atol=0)  # of 2^-10


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
def test_what_is_no_image_is_never_written(tmp_path, write):
    for bad in (math.nan, -1e-6):
        image = sky()
        image[4, 4, 1] = bad
        with pytest.raises(ValueError, match="image: expected values >= 0"):
            write(tmp_path / "a", image)
    with pytest.raises(TypeError):
        write(tmp_path / "a", sky().double())
    with pytest.raises(ValueError, match="shape"):
        write(tmp_path / "a", sky()[..., :2])
    with pytest.raises(OSError):
        write(tmp_path / "none" / "a", sky())
    for name, image, message in (("a.png", sky(), "path: expected"), ("a.exr", sky()[:8], "expected a map")):
        with pytest.raises(ValueError, match=message):
            write_environment(tmp_path / name, Environment(image))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("height", [1, 3, 8, 130])
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
    torch.testing.assert_close(back, values, rtol=1 / 256, atol=1e-38)  # 1e-39 is below the smallest exponent
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
    paths = sorted((shared_data / "hdri").glob("*.hdr"))[:3]
    assert len(paths) == 3
    for path in paths:
        image = read_hdr_image(path)
        theirs = np.array(mi.Bitmap(str(path)).convert(mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.Float32, False))
        np.testing.assert_allclose(image.numpy(), theirs, rtol=1e-6)  # the same integers times powers of two


@pytest.mark.parametrize("suffix", ["exr", "hdr"])
def test_mitsuba_sees_the_sun_where_we_put_it(tmp_path, suffix):
    """Here the center column is +X, right of it +Z; Mitsuba's center column is +Z, right of it -X."""
    mi = pytest.importorskip("mitsuba")
    mi.set_variant("scalar_rgb")
    height = 32
    for row, column in ((16, 32), (16, 48), (4, 10), (27, 60)):
        image = torch.full((height, 2 * height, 3), 0.01)
        image[row - 1 : row + 2, column - 1 : column + 2] = 100.0
        write_environment(tmp_path / f"sun.{suffix}", Environment(image))
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
        assert abs(float(light.eval(it)[0]) - 100.0) < 0.1  # Mitsuba's texels lie up to half a texel off, so 3 x 3
        it.wi = mi.Vector3f(d)
        assert float(light.eval(it)[0]) < 0.1


def window(*corners: int) -> tuple[np.ndarray, np.ndarray]:
    """Left, top, right, bottom, all inside, as the binding takes them."""
    return np.array(corners[:2], np.int32), np.array(corners[2:], np.int32)


def tiles(mode) -> OpenEXR.TileDescription:
    description = OpenEXR.TileDescription()
    description.xSize, description.ySize, description.mode = 16, 16, mode
    return description


def exr(path, planes: dict, **header) -> None:
    """An EXR file written by OpenEXR itself."""
    with OpenEXR.File({"type": OpenEXR.scanlineimage, **header}, dict(planes)) as file:
        file.write(str(path))


@pytest.mark.parametrize(
    "options, dtype",
    [
        ({"compression": OpenEXR.PIZ_COMPRESSION}, np.float32),
        ({"compression": OpenEXR.NO_COMPRESSION}, np.float16),
        ({"compression": OpenEXR.RLE_COMPRESSION}, np.float32),
        ({"compression": OpenEXR.ZIPS_COMPRESSION}, np.float16),
        ({"compression": OpenEXR.ZIP_COMPRESSION}, np.uint32),
        ({"type": OpenEXR.tiledimage, "tiles": tiles(OpenEXR.ONE_LEVEL)}, np.float32),
    ],
)
def test_exr_of_other_writers_reads(tmp_path, options, dtype):
    rng = np.random.default_rng(0)
    planes = {c: (rng.random((40, 80), np.float32) * 9).astype(dtype) for c in ("A", "B", "G", "R", "Z")}
    place = {"dataWindow": window(3, 7, 82, 46), "displayWindow": window(3, 7, 82, 46)}
    exr(tmp_path / "a.exr", planes, **place, **options)
    notes: list[str] = []
    got = read_hdr_image(tmp_path / "a.exr", notes=notes)
    assert np.array_equal(got.numpy(), np.stack([planes[c] for c in "RGB"], -1).astype(np.float32)) and not notes


def test_gray_and_cleaned_pixels(tmp_path):
    gray = np.ones((8, 16), np.float32)
    gray[0, :3] = (np.inf, -2.0, 5e5)
    exr(tmp_path / "a.exr", {"Y": gray})
    notes: list[str] = []
    image = read_hdr_image(tmp_path / "a.exr", notes=notes)
    assert image[0, :3, 2].tolist() == [HALF_MAX, 0.0, 5e5]
    assert notes == ["a.exr: 3 infinite values set to 65504, 3 negative to 0"]
    gray[0, 0] = np.nan
    exr(tmp_path / "a.exr", {"Y": gray})
    with pytest.raises(InputError, match="NaN at 1 pixels"):
        read_hdr_image(tmp_path / "a.exr")


@pytest.mark.parametrize(
    "display",
    [(0, 0, 31, 15), (2, 3, 9, 6), (-5, -4, 12, 5), (4, 2, 20, 3), (20, 2, 30, 4), (-9, 2, -2, 4), (0, 9, 7, 12)],
)
def test_the_display_window_is_the_image(tmp_path, display):
    rng = np.random.default_rng(1)
    planes, (left, top, right, bottom) = {c: rng.random((4, 8), np.float32) for c in "RGB"}, display
    exr(tmp_path / "a.exr", planes, dataWindow=window(2, 3, 9, 6), displayWindow=window(*display))
    notes: list[str] = []
    got = read_hdr_image(tmp_path / "a.exr", notes=notes).numpy()
    assert got.shape == (bottom - top + 1, right - left + 1, 3)
    y, x = np.mgrid[top : bottom + 1, left : right + 1]
    inside = (x >= 2) & (x <= 9) & (y >= 3) & (y <= 6)
    stored = np.stack([planes[c] for c in "RGB"], -1)[np.clip(y - 3, 0, 3), np.clip(x - 2, 0, 7)]
    assert np.array_equal(got, np.where(inside[..., None], stored, 0.0))
    assert [("dataWindow" in note) for note in notes] == ([True] if display != (2, 3, 9, 6) else [])


REC2020 = (0.708, 0.292, 0.170, 0.797, 0.131, 0.046, 0.3127, 0.3290)
AP1 = (0.713, 0.293, 0.165, 0.830, 0.128, 0.044, 0.32168, 0.33767)
AP0 = (0.7347, 0.2653, 0.0, 1.0, 0.0001, -0.077, 0.32168, 0.33767)
TO_REC709 = {  # ITU-R BT.2087-0; ACES with Bradford's adaptation, as OpenColorIO's built-in transforms have it
    REC2020: [[1.6605, -0.5876, -0.0728], [-0.1246, 1.1329, -0.0083], [-0.0182, -0.1006, 1.1187]],
    AP1: [[1.70505, -0.62179, -0.08326], [-0.13026, 1.14080, -0.01055], [-0.02400, -0.12897, 1.15297]],
    AP0: [[2.52169, -1.13413, -0.38756], [-0.27648, 1.37272, -0.09624], [-0.01538, -0.15298, 1.16835]],
}
INSIDE = np.array([[0.5, 0.4, 0.3], [0.2, 0.25, 0.2], [0.9, 0.9, 0.9], [0.3, 0.4, 0.5]], np.float32)  # of every gamut


@pytest.mark.parametrize(
    "header, primaries",
    [
        ({"chromaticities": REC2020}, REC2020),
        ({"chromaticities": AP1}, AP1),
        ({"colorInteropID": "lin_ap1_scene"}, AP1),
        ({"colorInteropID": "lin_rec2020_scene"}, REC2020),
        ({"acesImageContainerFlag": 1}, AP0),
        ({"chromaticities": (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290)}, None),
        ({"colorInteropID": "lin_rec709_scene"}, None),
    ],
)
def test_primaries_of_an_exr_are_converted(tmp_path, header, primaries):
    image = np.tile(INSIDE, (3, 2, 1))
    exr(tmp_path / "a.exr", {c: np.ascontiguousarray(image[..., k]) for k, c in enumerate("RGB")}, **header)
    notes: list[str] = []
    got = read_hdr_image(tmp_path / "a.exr", notes=notes).numpy()
    expected = image @ np.array(TO_REC709[primaries] if primaries else np.eye(3)).T
    np.testing.assert_allclose(got, expected, rtol=0, atol=2e-4)  # the recommendation has four digits
    assert len(notes) == bool(primaries) and all("Rec. 709" in note for note in notes)


def test_primaries_of_a_radiance_image_are_converted(tmp_path):
    image = np.tile(INSIDE, (4, 2, 1))
    write_hdr(tmp_path / "a.hdr", torch.from_numpy(image))
    stored = read_hdr_image(tmp_path / "a.hdr").numpy()
    line = b"\nPRIMARIES= " + " ".join(map(str, REC2020)).encode() + b"\n\n"
    (tmp_path / "b.hdr").write_bytes((tmp_path / "a.hdr").read_bytes().replace(b"\n\n", line, 1))
    got = read_hdr_image(tmp_path / "b.hdr").numpy()
    np.testing.assert_allclose(got, stored @ np.array(TO_REC709[REC2020]).T, rtol=0, atol=2e-4)


def test_primaries_of_zero_are_none(tmp_path):
    """Photoshop's header, as of Poly Haven's studio_small_03_1k.hdr."""
    expected = round_trip(tmp_path / "a.hdr", "-Y 6 +X 12", QUADS.tobytes(), b"#?RADIANCE\n\n")
    for zero in (b"0", b"0.0000"):
        header = b"#?RADIANCE\n# Made with Adobe Photoshop\nGAMMA=1\nPRIMARIES=%s\nFORMAT=32-bit_rle_rgbe\n\n"
        got = round_trip(tmp_path / "a.hdr", "-Y 6 +X 12", QUADS.tobytes(), header % b" ".join([zero] * 8))
        np.testing.assert_array_equal(got, expected)


def test_colors_outside_rec709_are_clamped_and_counted(tmp_path):
    exr(tmp_path / "a.exr", {c: np.full((2, 4), float(c == "G"), np.float32) for c in "RGB"}, chromaticities=AP1)
    notes: list[str] = []
    assert read_hdr_image(tmp_path / "a.exr", notes=notes)[0, 0].tolist() == pytest.approx([0, 1.1408, 0], abs=1e-4)
    assert notes[1] == "a.exr: 0 infinite values set to 65504, 16 negative to 0"


PLANE = np.ones((4, 8), np.float32)


@pytest.mark.parametrize(
    "planes, header, message",
    [
        ({"Y": PLANE, "RY": PLANE, "BY": PLANE}, {}, "channels: expected R, G, B or Y, got"),
        ({"X": PLANE, "Y": PLANE, "Z": PLANE}, {}, "channels: expected R, G, B or Y, got"),
        ({"R": PLANE, "G": PLANE}, {}, "channels: expected R, G, B or Y, got"),
        ({"G": PLANE}, {}, "channels: expected R, G, B or Y, got"),
        ({"left.R": PLANE, "left.G": PLANE, "left.B": PLANE}, {}, "channels: expected R, G, B or Y, got"),
        ({"Y": PLANE}, {"type": OpenEXR.tiledimage, "tiles": tiles(OpenEXR.MIPMAP_LEVELS)}, "EXR tiles: expected one"),
        ({"Y": PLANE}, {"envmap": OpenEXR.ENVMAP_CUBE}, "envmap: expected a lat-long map"),
        ({"Y": PLANE}, {"chromaticities": (0.3,) * 8}, "chromaticities: expected primaries and a white"),
        ({"Y": PLANE}, {"colorInteropID": "srgb_rec709_scene"}, "colorInteropID: expected a linear RGB space"),
    ],
)
def test_an_exr_that_would_be_misread_is_refused(tmp_path, planes, header, message):
    exr(tmp_path / "a.exr", planes, **header)
    with pytest.raises(InputError, match=message):
        read_hdr_image(tmp_path / "a.exr")


def test_subsampled_channels_and_several_parts_are_refused(tmp_path):
    exr(tmp_path / "a.exr", {"Y": PLANE})
    data, steps = (tmp_path / "a.exr").read_bytes(), [struct.pack("<iIii", 2, 0, n, n) for n in (1, 2)]
    (tmp_path / "a.exr").write_bytes(data.replace(*steps))
    with pytest.raises(InputError, match="channels: expected one sample for each pixel"):
        read_hdr_image(tmp_path / "a.exr")
    with OpenEXR.File([OpenEXR.Part({}, {c: PLANE.copy() for c in "RGB"}, name) for name in ("a", "b")]) as file:
        file.write(str(tmp_path / "a.exr"))
    with pytest.raises(InputError, match="EXR kind: expected one flat image"):
        read_hdr_image(tmp_path / "a.exr")


def test_header_fields_that_are_not_applied_are_noted(tmp_path):
    exr(tmp_path / "a.exr", {"Y": PLANE}, envmap=OpenEXR.ENVMAP_LATLONG, pixelAspectRatio=2.0)
    write_hdr(tmp_path / "b.hdr", torch.ones(4, 8, 3))
    data = (tmp_path / "b.hdr").read_bytes().replace(b"\n\n", b"\nPIXASPECT=0.5\nGAMMA=2.2\n\n", 1)
    (tmp_path / "b.hdr").write_bytes(data)
    notes: list[str] = []
    for name in ("a.exr", "b.hdr"):
        read_environment(tmp_path / name, notes=notes)
    assert [note.split(":")[1].split()[0] for note in notes] == ["envmap", "pixelAspectRatio", "PIXASPECT", "GAMMA"]


QUADS = np.random.default_rng(5).integers(0, 256, (6, 12, 4), dtype=np.uint8)
QUADS[..., 3] = 128  # value: mantissa over 256
HEAD = b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n"


def round_trip(path, resolution: str, pixels: bytes, head: bytes = HEAD) -> np.ndarray:
    """Mantissas that are read from a file of ``pixels``."""
    path.write_bytes(head + resolution.encode() + b"\n" + pixels)
    return np.rint(read_hdr_image(path).numpy() * 256)


@pytest.mark.parametrize(
    "resolution, placed",
    [  # the order of rows in the file: Radiance's "File Formats", resolution string
        ("-Y 6 +X 12", lambda q: q),
        ("-Y 6 -X 12", lambda q: q[:, ::-1]),
        ("+Y 6 -X 12", lambda q: q[::-1, ::-1]),
        ("+Y 6 +X 12", lambda q: q[::-1]),
        ("+X 12 -Y 6", lambda q: q.transpose(1, 0, 2)),
        ("-X 12 -Y 6", lambda q: q[:, ::-1].transpose(1, 0, 2)),
        ("-X 12 +Y 6", lambda q: q[::-1, ::-1].transpose(1, 0, 2)),
        ("+X 12 +Y 6", lambda q: q[::-1].transpose(1, 0, 2)),
    ],
)
def test_images_of_all_orientations(tmp_path, resolution, placed):
    got = round_trip(tmp_path / "a.hdr", resolution, placed(QUADS).tobytes())
    assert np.array_equal(got, QUADS[..., :3])


@pytest.mark.parametrize("first", [(2, 2, 128, 9), (2, 2, 255, 128), (2, 2, 0, 128), (2, 2, 1, 12), (2, 3, 0, 12)])
def test_flat_pixels_that_begin_like_run_lengths(tmp_path, first):
    quads = QUADS.copy()
    quads[0, 0] = quads[3, 0] = first
    got = round_trip(tmp_path / "a.hdr", "-Y 6 +X 12", quads.tobytes())
    expected = quads[..., :3] * 2.0 ** (quads[..., 3:].astype(float) - 128)
    assert np.array_equal(got, np.rint(expected))


def test_run_lengths_of_before_1991(tmp_path):
    """(1, 1, 1, n) repeats the pixel before; repeats in a row are the bytes of one count, the lowest first."""
    a, b, c = bytes((9, 8, 7, 128)), bytes((1, 1, 2, 128)), bytes((200, 2, 2, 128))

    def again(n):
        return bytes((1, 1, 1, n))

    lines = a + again(0) + again(1) + b * 2 + c + again(41)  # 1 + 256 + 2 + 1 + 41 pixels
    lines += b + again(44) + again(1)  # 1 + 44 + 256 pixels
    lines += c * 300 + again(200)  # more than the scanline has
    got = round_trip(tmp_path / "a.hdr", "-Y 3 +X 301", lines)
    expected = [[a] * 257 + [b] * 2 + [c] * 42, [b] * 301, [c] * 301]
    assert np.array_equal(got, np.frombuffer(b"".join(sum(expected, [])), np.uint8).reshape(3, 301, 4)[..., :3])
    for broken in (a * 200, a + again(10)):
        with pytest.raises(InputError, match="pixels: expected all scanlines"):
            round_trip(tmp_path / "b.hdr", "-Y 1 +X 301", broken)


def test_scanlines_of_several_kinds_in_one_image(tmp_path):
    rle = bytes((2, 2, 0, 12)) + b"".join(b"\x0c" + QUADS[1, :, k].tobytes() for k in range(4))
    old = QUADS[2].copy()
    old[5:] = old[4]
    pixels = QUADS[0].tobytes() + rle + old[:5].tobytes() + bytes((1, 1, 1, 7))
    got = round_trip(tmp_path / "a.hdr", "-Y 3 +X 12", pixels)
    assert np.array_equal(got, np.stack([*QUADS[:2], old])[..., :3])


@pytest.mark.parametrize(
    "head, factor",
    [
        (b"#?RADIANCE\nEXPOSURE=2\nEXPOSURE= 0.25\nFORMAT=32-bit_rle_rgbe\n\n", [2, 2, 2]),
        (b"#?RADIANCE\nCOLORCORR=2 1 0.5\nCOLORCORR= 1 4 1\nEXPOSURE=0.5\n\n", [1, 0.5, 4]),
        (b"#?RADIANCE\n\tEXPOSURE=2\n# a comment\npcomb -s 2 EXPOSURE=3\nFORMAT=32-bit_rle_rgbe\n\n", [1, 1, 1]),
        (b"#?RGBE\r\nEXPOSURE=2\r\n\r\n", [0.5] * 3),
        (b"#?other\nFORMAT= 32-bit_rle_rgbe \n\n", [1, 1, 1]),
    ],
)
def test_exposure_and_color_correction_are_divided_out(tmp_path, head, factor):
    path = tmp_path / "a.hdr"
    path.write_bytes(head + b"-Y 6 +X 12\n" + QUADS.tobytes())
    np.testing.assert_allclose(read_hdr_image(path).numpy(), QUADS[..., :3] / 256.0 * factor, rtol=1e-6)


SIZE = "-Y 6 +X 12"


@pytest.mark.parametrize(
    "line, resolution, message",
    [
        (b"FORMAT=32-bit_rle_xyze", SIZE, "FORMAT: expected 32-bit_rle_rgbe"),
        (b"COLORCORR=1 2", SIZE, "COLORCORR: expected 3 positive numbers"),
        (b"EXPOSURE=-1", SIZE, "EXPOSURE: expected a positive number"),
        (b"PRIMARIES=0.3 0.3 0.3 0.3 0.3 0.3 0.3 0.3", SIZE, "PRIMARIES: expected"),
        (b"PRIMARIES=0.64 0.33", SIZE, "PRIMARIES: expected"),
        (b"#", "-Y 6 -Y 12", "resolution: expected"),
        (b"#", "Y 6 X 12", "resolution: expected"),
        (b"#", "-Y 6 +X", "resolution: expected"),
        (b"#", "-Y -6 +X 12", "resolution: expected"),
        (b"#", "-Y 6 +X 12 1", "resolution: expected"),
        (b"#", "-Z 6 +X 12", "resolution: expected"),
    ],
)
def test_headers_that_cannot_be_applied_are_refused(tmp_path, line, resolution, message):
    with pytest.raises(InputError, match=message):
        round_trip(tmp_path / "a.hdr", resolution, QUADS.tobytes(), b"#?RADIANCE\n" + line + b"\n\n")
