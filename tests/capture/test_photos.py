"""Reading photographs and videos for a capture: EXIF, order, sharpness, refusals."""

from __future__ import annotations

import re
import struct
import warnings
from fractions import Fraction
from pathlib import Path
from types import SimpleNamespace

import av
import numpy as np
import pillow_heif
import pytest
from PIL import ExifTags, Image, ImageCms

from reli3d.capture.capture import CaptureOptions, capture
from reli3d.capture.photos import FEWEST, FRAME_COUNT, focal_from_exif, read_photos, sharpness
from reli3d.errors import InputError
from reli3d.io.images import decode_image, exposure, with_exposure

BASE = ExifTags.Base


def quiet(stage: str, done: int, total: int) -> None:
    """A progress callback that shows nothing."""


def textured(seed: int, width: int = 320, height: int = 240) -> np.ndarray:
    rng = np.random.default_rng(seed)
    coarse = Image.fromarray(rng.integers(0, 255, (height // 4, width // 4, 3), dtype=np.uint8))
    return np.asarray(coarse.resize((width, height), Image.Resampling.NEAREST))


def photographs(folder: Path, images, form: str = "png", **options) -> Path:
    """``folder`` with ``0.png``, ``1.png`` ... of images or arrays."""
    folder.mkdir(exist_ok=True)
    for k, image in enumerate(images):
        (image if isinstance(image, Image.Image) else Image.fromarray(image)).save(folder / f"{k}.{form}", **options)
    return folder


def test_focal_length_of_a_canon_comes_from_its_sensor():
    """100 mm on a sensor 22.3 mm wide, at 5184 pixels: 100 / 22.3 of the width, whatever the file was reduced to."""
    tags = {
        BASE.FocalLength: 100.0,
        BASE.FocalPlaneXResolution: 5184 / (22.3 / 25.4),
        BASE.FocalPlaneResolutionUnit: 2,
        BASE.ExifImageWidth: 5184,
        BASE.ExifImageHeight: 3456,
    }
    assert focal_from_exif(tags, (1000, 667), 1000) == pytest.approx(1000 * 100 / 22.3, rel=1e-6)  # closed form
    tags[BASE.FocalPlaneResolutionUnit] = 3  # the same number for a centimeter is another sensor
    assert focal_from_exif(tags, (1000, 667), 1000) == pytest.approx(1000 * 100 / 22.3 * 2.54, rel=1e-6)


def test_focal_length_of_a_phone_comes_from_its_35_mm_equivalent():
    assert focal_from_exif({BASE.FocalLengthIn35mmFilm: 26}, (4032, 3024), 2000) == pytest.approx(2000 * 26 / 36)
    assert focal_from_exif({}, (4032, 3024), 2000) is None
    assert focal_from_exif({BASE.FocalLengthIn35mmFilm: 0}, (4032, 3024), 2000) is None


def test_photographs_are_upright_reduced_and_in_order(tmp_path):
    exif = Image.Exif()
    exif[BASE.Orientation] = 6  # turn by 90 degrees clockwise to show
    for k in range(8):
        Image.fromarray(textured(k, *((2400, 1200) if k == 7 else ()))).save(tmp_path / f"{9 - k}.jpg", exif=exif)
    photos, _ = read_photos(tmp_path, quiet)
    assert [p.name for p in photos] == [str(k) for k in range(2, 10)]
    assert photos[0].size == (1000, 2000)
    expected = Image.fromarray(np.rot90(textured(7, 2400, 1200), -1)).resize((1000, 2000), Image.Resampling.BOX)
    difference = np.abs(photos[0].pixels.astype(int) - np.asarray(expected).astype(int))
    assert difference.mean() < 25  # JPEG of noise; a wrong turn differs by 85


def test_heic_photographs_are_upright(tmp_path):
    exif = Image.Exif()
    exif[BASE.Orientation] = 6
    exif.get_ifd(ExifTags.IFD.Exif)[BASE.FocalLengthIn35mmFilm] = 26
    file = pillow_heif.from_pillow(Image.fromarray(textured(0, 80, 60)))
    for k in range(8):
        file.save(tmp_path / f"{k}.HEIC", exif=exif.tobytes())
    photos, _ = read_photos(tmp_path, quiet)
    assert photos[0].size == (60, 80) and photos[0].focal == pytest.approx(80 * 26 / 36)
    difference = np.abs(photos[0].pixels.astype(int) - np.rot90(textured(0, 80, 60), -1).astype(int))
    assert difference.mean() < 25  # HEVC of noise; a wrong turn differs by 85


def test_masks_are_found_by_name_before_the_mapping(tmp_path):
    source, masks = photographs(tmp_path / "photographs", map(textured, range(8)), "jpg"), tmp_path / "masks"
    labels = Image.fromarray(np.uint8([[0], [100], [200]]).repeat(3, 1)).resize((320, 240), 0)
    black = Image.new("L", (320, 240))  # the object is in none of the images
    masks.mkdir()
    for files, message in (
        ({"other0.png": black}, "masks with the names of the photographs.* at least 8 of 8, got 0"),
        ({"0.jpg.png": Image.new("L", (100, 100))}, r"0\.jpg\.png.*aspect of 320 x 240"),  # as COLMAP names it
        ({"0.png": black}, r"one mask of 0, got 0\.jpg\.png, 0\.png"),
        ({"0.png": labels, "0.jpg.png": None}, r"0\.png: .*labels"),
        ({f"{k}.png": black for k in range(8)}, "at least 8 of 8, got 0"),
    ):
        for name, image in files.items():
            image.save(masks / name) if image else (masks / name).unlink()
        with pytest.raises(InputError, match=message):
            capture(source, tmp_path / "object", CaptureOptions(masks=masks))
    assert not (tmp_path / "object").exists()


def test_the_exif_orientation_of_masks_is_applied(tmp_path):
    exif, black = Image.Exif(), 8 * [Image.new("L", (320, 240))]
    exif[BASE.Orientation] = 6
    source = photographs(tmp_path / "photographs", map(textured, range(8)), "jpg", exif=exif)
    for options, message in (
        ({}, r"0\.png: .*240 x 320, got 320 x 240; turn it .* EXIF orientation"),
        ({"exif": exif}, "at least 8 of 8, got 0"),  # they fit, but are black
    ):
        masks = photographs(tmp_path / "masks", black, **options)
        with pytest.raises(InputError, match=message):
            capture(source, tmp_path / "object", CaptureOptions(masks=masks))
    exif[BASE.Orientation] = 3
    mask, notes = textured(0)[..., 0], []
    Image.fromarray(mask).save(tmp_path / "a.png", exif=exif)
    assert np.array_equal(decode_image(tmp_path / "a.png", notes=notes, upright=True), mask[::-1, ::-1]) and not notes


def test_alpha_is_a_mask_where_all_photographs_have_it(tmp_path):
    pixels = np.dstack([textured(0), np.zeros((240, 320), np.uint8)])
    photographs(tmp_path, 8 * [pixels])
    with pytest.raises(InputError, match="alpha: expected .* for at least 8 of 8, got 0"):
        capture(tmp_path, tmp_path / "object")
    pixels[:, :100, 3] = 255
    Image.fromarray(pixels).save(tmp_path / "8.png")
    Image.fromarray(pixels[..., :3]).save(tmp_path / "9.png")
    photos, notes = read_photos(tmp_path, quiet)
    assert np.array_equal(photos[8].alpha, pixels[..., 3]) and photos[9].alpha is None
    assert np.array_equal(photos[8].pixels[:, :100], pixels[:, :100, :3]) and (photos[8].pixels[:, 100:] == 255).all()
    assert "alpha of 9 of 10 photographs is not used: the others have none; give --masks" in notes


def test_names_are_unique_in_any_case_and_keep_their_dots(tmp_path):
    names = ["12.30.45.png", "12.30.46.png", "A.jpg", "a.png", "a.png.png", "b.png", "c.png", "d.png"]
    for k, name in enumerate(names):
        Image.fromarray(textured(k)).save(tmp_path / name)
    photos, _ = read_photos(tmp_path, quiet)
    assert [p.name for p in photos] == ["12.30.45", "12.30.46", "A.jpg", "a.png", "a.png.png", "b", "c", "d"]


def test_large_photographs_are_read_without_a_warning(tmp_path, monkeypatch):
    photographs(tmp_path, map(textured, range(8)))
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", 320 * 240 - 1)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert len(read_photos(tmp_path, quiet)[0]) == 8
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", 320 * 240 // 2 - 1)  # Pillow refuses twice as many
    with pytest.raises(InputError, match=r"0\.png: expected at most 134 million pixels; save it smaller"):
        read_photos(tmp_path, quiet)


@pytest.mark.parametrize(
    "values, name, options, message",
    [
        (np.full((9, 9), 0.5, np.float32), "0.tif", {}, "expected 8 or 16 bit gray or color, got mode F; save as"),
        (np.full((9, 9), 70000, np.int32), "0.tif", {}, "expected 8 or 16 bit gray, got 32 bit; save as"),
        (np.zeros((9, 9), np.uint8), "0.jpg", {"format": "BMP"}, "cannot be decoded"),  # as PostScript, which is run
    ],
)
def test_what_an_object_folder_cannot_hold_is_no_photograph_either(tmp_path, values, name, options, message):
    Image.fromarray(values).save(tmp_path / name, **options)
    with pytest.raises(InputError, match=message):
        read_photos(tmp_path, quiet)


def test_exposures_are_read_and_written(tmp_path):
    for k in range(8):
        Image.fromarray(textured(k)).save(tmp_path / f"{k}.jpg", exif=with_exposure((1 / (50 + k), 2.8, 100)))
    photos, _ = read_photos(tmp_path, quiet)
    assert [p.exposure for p in photos] == [pytest.approx((1 / (50 + k), 2.8, 100.0), rel=1e-3) for k in range(8)]
    Image.fromarray(textured(0)).save(tmp_path / "copy.jpg", exif=with_exposure(photos[0].exposure))
    assert exposure(tmp_path / "copy.jpg") == pytest.approx(100 / 50 / 2.8**2, rel=1e-3)


def test_flash_and_mixed_sizes_are_reported(tmp_path):
    # fired: 1 and auto, 0x19; not fired: off, 0x10, and auto, 0x18
    for k, flash in enumerate([0x01, 0x19, 0x19, 0x10, 0x18, 0x18, 0x00, 0x20]):
        exif = Image.Exif()
        exif.get_ifd(ExifTags.IFD.Exif)[BASE.Flash] = flash
        pixels = textured(k) if k else textured(k, 200, 200)
        Image.fromarray(pixels).save(tmp_path / f"{k}.jpg", exif=exif)
    _, notes = read_photos(tmp_path, quiet)
    assert any("3 of 8" in n and "flash: the lighting differs" in n for n in notes)
    assert any("2 image sizes" in n for n in notes) and any("no focal length" in n for n in notes)


def test_gray_photographs_of_16_bits_keep_their_contrast(tmp_path):
    gray = textured(0)[..., 0]
    photos, _ = read_photos(photographs(tmp_path, 8 * [gray.astype(np.uint16) * 257]), quiet)
    assert np.array_equal(photos[0].pixels, np.repeat(gray[..., None], 3, -1))


def write_video(target, images, *, crf: int = 12, dst_colorspace: str | None = None, form: str | None = None, **tags):
    """target: a path, or what has ``write``.  tags: of the codec."""
    with av.open(target, "w", format=form, options={"movflags": "faststart"} if form is None else {}) as file:
        stream = file.add_stream("libx264", rate=30, options={"crf": str(crf)})
        (stream.width, stream.height), stream.pix_fmt = images[0].size, "yuv420p"
        for name, value in tags.items():
            setattr(stream.codec_context, name, value)
        for image in images:
            frame = av.VideoFrame.from_image(image)
            file.mux(stream.encode(frame.reformat(format="yuv420p", dst_colorspace=dst_colorspace)))
        file.mux(stream.encode())


def test_a_video_without_a_length_is_read_to_its_end_with_square_pixels(tmp_path):
    path = tmp_path / "stream.mkv"
    images = [Image.fromarray(textured(k // 2)) for k in range(2 * FRAME_COUNT)]
    with path.open("wb") as file:
        sink = SimpleNamespace(write=file.write)  # cannot be rewound, as a pipe: the file has no length
        write_video(sink, images, form="matroska", sample_aspect_ratio=Fraction(4, 3), color_trc=16)  # PQ
    photos, notes = read_photos(path, quiet)
    assert len(photos) == FRAME_COUNT and "60 sharp frames taken of 120" in notes[0]
    assert photos[0].size == (427, 240) and any("HDR" in note for note in notes)
    last = np.asarray(Image.fromarray(textured(FRAME_COUNT - 1)).resize((427, 240)), np.float64)
    assert np.corrcoef(photos[-1].pixels.ravel(), last.ravel())[0, 1] > 0.8  # other frames: near 0


@pytest.mark.parametrize("tagged", [False, True])
def test_high_definition_video_without_a_color_space_is_bt_709(tmp_path, tagged):
    images, tags = FEWEST * [Image.new("RGB", (1280, 720), (200, 40, 40))], {"colorspace": 1} if tagged else {}
    write_video(str(tmp_path / "clip.mp4"), images, crf=4, dst_colorspace="ITU709", **tags)
    photos, _ = read_photos(tmp_path / "clip.mp4", quiet)
    assert np.abs(photos[0].pixels[300, 300].astype(int) - (200, 40, 40)).max() <= 3


DISPLAY_P3 = (0.51512, 0.24120, -0.00105), (0.29198, 0.69225, 0.04189), (0.15710, 0.06657, 0.78407)  # adapted to D50
SRGB = (0.43607, 0.22249, 0.01392), (0.38515, 0.71687, 0.09708), (0.14307, 0.06061, 0.71410)


def matrix_profile(title: str, columns: tuple, exponent: float) -> bytes:
    """An ICC profile with the XYZ of red, green and blue, and an exponent."""
    number = lambda v: round(v * 65536).to_bytes(4, "big", signed=True)
    xyz = lambda *v: b"XYZ \0\0\0\0" + b"".join(map(number, v))
    curve = b"curv\0\0\0\0" + (1).to_bytes(4, "big") + round(exponent * 256).to_bytes(2, "big") + b"\0\0"
    name = title.encode() + b"\0"
    text = b"desc\0\0\0\0" + len(name).to_bytes(4, "big") + name + b"\0" * (79 + -len(name) % 4)
    tags = {b"desc": text, b"wtpt": xyz(0.9642, 1.0, 0.8249), **dict.fromkeys((b"rTRC", b"gTRC", b"bTRC"), curve)}
    tags |= {key: xyz(*column) for key, column in zip((b"rXYZ", b"gXYZ", b"bXYZ"), columns, strict=True)}
    table, data, at = len(tags).to_bytes(4, "big"), b"", 128 + 4 + 12 * len(tags)
    for key, value in tags.items():
        value += b"\0" * (-len(value) % 4)
        table += key + (at + len(data)).to_bytes(4, "big") + len(value).to_bytes(4, "big")
        data += value
    header = (at + len(data)).to_bytes(4, "big") + b"\0\0\0\0" + b"\x02\x10\0\0" + b"mntrRGB XYZ "
    header += b"\0" * 12 + b"acsp" + b"\0" * 28 + number(0.9642) + number(1.0) + number(0.8249)
    return header.ljust(128, b"\0") + table + data


def test_photographs_in_display_p3_are_converted(tmp_path):
    """sRGB (200, 30, 30) lies at (183, 51, 42) there; an exponent of 2.2 differs from sRGB's curve by up to 6."""
    profile = matrix_profile("Display P3", DISPLAY_P3, 2.2)
    images = 8 * [Image.new("RGB", (320, 240), (183, 51, 42))]
    photos, notes = read_photos(photographs(tmp_path, images, icc_profile=profile), quiet)
    assert np.abs(photos[0].pixels[100, 100].astype(int) - (200, 30, 30)).max() <= 7
    assert any("converted from Display P3 to sRGB; 8 of 8" in note for note in notes)
    found = []
    bitmap = decode_image(tmp_path / "0.png", notes=found)
    assert np.array_equal(np.asarray(bitmap), photos[0].pixels) and "Display P3" in found[0]


def test_a_profile_is_judged_by_its_colors(tmp_path):
    """sRGB's curve takes the linear values 0.5 and 0.1 to 188 and 89."""
    linear = matrix_profile("GIMP built-in Linear sRGB", SRGB, 1.0)
    same = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    color, path = Image.new("RGB", (9, 9), (128, 128, 26)), tmp_path / "a.png"
    for image, profile, expected, note in (
        (color, same, (128, 128, 26), ""),
        (color, linear, (188, 188, 89), "converted from GIMP"),
        (color.quantize(2), linear, (188, 188, 89), "converted from GIMP"),
        (color.convert("L"), linear, (118, 118, 118), "profiles of gray images are not used"),
    ):
        notes: list[str] = []
        image.save(path, icc_profile=profile)
        bitmap = decode_image(path, notes=notes).convert("RGB")
        assert np.abs(np.subtract(bitmap.getpixel((0, 0)), expected)).max() <= 2  # each step rounds to 8 bits
        assert note in "".join(notes) and len(notes) == bool(note)


def ink_profile() -> bytes:
    """A CMYK profile whose only color is the lightness of white without black ink, and of black with it."""
    ramp = bytes(range(256))
    nodes = b"".join(bytes([0 if k % 2 else 255, 128, 128]) for k in range(16))  # L*a*b*; the last ink changes first
    lut = struct.pack(">4s4x4B9i", b"mft1", 4, 3, 2, 0, *(65536 * v for v in (1, 0, 0, 0, 1, 0, 0, 0, 1)))
    lut += 4 * ramp + nodes + 3 * ramp
    tags = struct.pack(">I4s2I", 1, b"A2B0", 144, len(lut))
    header = struct.pack(
        ">I4xI12s12x4s28x3i48x", 144 + len(lut), 0x02100000, b"prtrCMYKLab ", b"acsp", 63190, 65536, 54061
    )
    return header + tags + lut


def test_cmyk_is_converted_by_its_profile(tmp_path):
    for profile, expected, note in (
        (ink_profile(), (255, 255, 255), "colors converted from"),
        (matrix_profile("RGB", SRGB, 1.0), (255, 0, 0), "its color profile is not used"),
    ):
        notes: list[str] = []
        Image.new("CMYK", (16, 16), (0, 255, 255, 0)).save(tmp_path / "a.tif", icc_profile=profile)
        bitmap = decode_image(tmp_path / "a.tif", notes=notes)
        assert bitmap.mode == "RGB" and np.abs(np.subtract(bitmap.getpixel((0, 0)), expected)).max() <= 2
        assert note in notes[0] and len(notes) == 1


def test_adobe_rgb_is_known_by_exif_alone(tmp_path):
    """Adobe RGB (1998) encoding, 4.3: an exponent of 563/256; the matrix to linear sRGB, of both XYZ matrices."""
    exif, path = Image.Exif(), tmp_path / "0.jpg"
    ifd = exif.get_ifd(ExifTags.IFD.Exif)
    stored, matrix = (60, 180, 90), [[1.39836, -0.39836, 0.0], [0.0, 1.0, 0.0], [0.0, -0.04293, 1.04293]]
    linear = np.clip(matrix @ (np.array(stored) / 255) ** (563 / 256), 0, 1)
    converted = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055) * 255
    for space, index, expected in ((65535, "R03", converted), (65535, "R98", stored), (1, "R03", stored)):
        ifd[BASE.ColorSpace], ifd[ExifTags.IFD.Interop], notes = space, {1: index}, []
        Image.new("RGB", (16, 16), stored).save(path, exif=exif, quality=100)
        pixel = decode_image(path, notes=notes).getpixel((8, 8))
        assert np.abs(np.subtract(pixel, expected)).max() <= 3  # JPEG rounds to 8 bits twice
        assert notes == ["0.jpg: colors converted from Adobe RGB (1998) to sRGB"] * (expected is converted)


def test_the_sharpest_frame_of_each_window_of_a_video_is_taken(tmp_path):
    """Every third frame is sharp, the others are blurred; there are three frames a window."""
    path = tmp_path / "clip.mp4"
    sharp = [Image.fromarray(textured(k)) for k in range(FRAME_COUNT)]
    blurred = [image.resize((20, 15), Image.Resampling.BOX).resize((320, 240)) for image in sharp]
    write_video(str(path), [image for three in zip(blurred, sharp, blurred, strict=True) for image in three])
    photos, notes = read_photos(path, quiet)
    assert len(photos) == FRAME_COUNT
    assert min(sharpness(p.pixels) for p in photos) > 0.5 * sharpness(textured(0))  # blurred ones have a tenth
    assert "60 sharp frames taken of 180" in notes[0] and "no focal length" in notes[-1]
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])  # the index comes first: half of the frames are there
    photos, notes = read_photos(path, quiet)
    assert 20 < len(photos) < 40 and re.match(r"only \d+ of the 180 frames", notes[1])
    path.write_bytes(data[: len(data) // 20])
    with pytest.raises(InputError, match=r"cannot be decoded \("):
        read_photos(path, quiet)


def test_photographs_that_are_not_in_the_folder_itself_are_named(tmp_path):
    (tmp_path / "mug.MOV").write_bytes(b"video")
    with pytest.raises(InputError, match=rf"got 1 video; run: reli3d capture {tmp_path}/mug.MOV {tmp_path}-object"):
        read_photos(tmp_path, quiet)
    (tmp_path / "mug.MOV").unlink()
    album = photographs(tmp_path / "100APPLE", map(textured, range(2)))
    with pytest.raises(InputError, match=f"got 2 photographs in 100APPLE; run: reli3d capture {album} {album}-object"):
        read_photos(tmp_path, quiet)
    (tmp_path / "1.DNG").write_bytes(b"raw")
    with pytest.raises(InputError, match=r"1\.DNG: expected JPEG, HEIC or PNG photographs; convert them"):
        read_photos(tmp_path, quiet)


def test_a_folder_that_cannot_be_listed_is_refused(tmp_path, monkeypatch):
    def refuse(_):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Path, "iterdir", refuse)
    with pytest.raises(InputError, match=r"cannot be read \(Permission denied\); check its permissions"):
        read_photos(tmp_path, quiet)


def test_inputs_that_are_no_capture_are_refused_in_one_line(tmp_path):
    with pytest.raises(InputError, match="file not found"):
        read_photos(tmp_path / "nothing.jpg", quiet)
    (tmp_path / "notes.txt").write_text("no photograph")
    with pytest.raises(InputError, match="folder of photographs or a video"):
        read_photos(tmp_path / "notes.txt", quiet)
    few = photographs(tmp_path / "few", map(textured, range(3)))
    with pytest.raises(InputError, match="at least 8 photographs, got 3"):
        read_photos(few, quiet)
    (few / "3.jpg").write_bytes(b"\xff\xd8\xff\xe0 broken")
    with pytest.raises(InputError, match=r"3\.jpg: cannot be decoded"):
        read_photos(few, quiet)
    (tmp_path / "broken.mp4").write_bytes(b"\0\0\0\x18ftypmp42" + bytes(400))
    with pytest.raises(InputError, match=r"cannot be decoded \('Invalid data found when processing input'\)"):
        read_photos(tmp_path / "broken.mp4", quiet)
