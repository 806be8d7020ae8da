"""Photographs of a folder, or sharp frames of a video, with the lens data of their files."""

from __future__ import annotations

import importlib
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType

import cv2
import numpy as np
from PIL import ExifTags, Image, ImageOps

from reli3d.errors import InputError, shown
from reli3d.io.files import file_size
from reli3d.io.images import FORMATS, check_depth, exposure_data, in_srgb
from reli3d.views.masks import alpha_values
from reli3d.views.missing_cameras import PHOTOGRAPHS, VIDEOS, capture_command

LONGEST_SIDE = 2000  # pixels of a photograph that is kept
FRAME_COUNT = 60  # frames taken from a video
MOST_PHOTOS = 120  # of a folder: of more every second, third, ... is read
FEWEST = 8  # photographs, below which no closed shape can be expected
MAX_PIXELS = 1 << 27
TOO_LARGE = f"expected at most {MAX_PIXELS / 1e6:.0f} million pixels"
UNSPECIFIED, HD = 2, 720  # FFmpeg's number of an unknown color space; rows of high definition
HDR_TRANSFERS = (16, 18)  # PQ and HLG, as FFmpeg numbers transfer functions
WHOLE_VIDEO = 0.9  # fraction of the frames that a file announces, below which it is cut off
SHARPNESS_SIDE = 640  # pixels at which sharpness is compared
MILLIMETERS = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}  # EXIF FocalPlaneResolutionUnit

Progress = Callable[[str, int, int], None]  # stage, steps done, steps in all


@dataclass(frozen=True)
class Photo:
    """One image as the mapping reads it."""

    name: str  # unique; without suffix
    pixels: np.ndarray  # (H, W, 3) uint8, sRGB, upright
    focal: float | None  # pixels, from EXIF; None if it is missing
    lens: tuple  # equal for photographs of one lens and size
    flash: bool = False
    alpha: np.ndarray | None = None  # (H, W) uint8, if some of it is transparent: a mask
    exposure: tuple[float, float, float] | None = None  # of reli3d.io.images.exposure_data

    @property
    def size(self) -> tuple[int, int]:
        """Width and height."""
        return self.pixels.shape[1], self.pixels.shape[0]


def read_photos(source: Path, progress: Progress) -> tuple[list[Photo], list[str]]:
    """Photographs of a folder in the order of their names, or frames of a video, and notes on them.

    Images are turned by their EXIF orientation and reduced to LONGEST_SIDE.  Raises InputError where ``source`` is
    neither, where a file is broken, and where there are fewer than FEWEST images.
    """
    if source.is_dir():
        photos, notes = _read_folder(source, progress)
    elif source.suffix.lower() in VIDEOS:
        photos, notes = _read_video(source, progress)
    else:
        file_size(source)
        raise InputError(source, "expected a folder of photographs or a video (mp4, mov); check the path")
    if not photos and (error := capture_command(source, "a folder with photographs, got {}")):
        raise error
    if len(photos) < FEWEST:
        raise InputError(
            source, f"expected at least {FEWEST} photographs, got {len(photos)}; take 30 to 70 all around the object"
        )
    sizes = {p.size for p in photos}
    if 0 < (cut_out := sum(p.alpha is not None for p in photos)) < len(photos):
        notes.append(f"alpha of {cut_out} of {len(photos)} photographs is not used: the others have none; give --masks")
    if len(sizes) > 1:
        notes.append(f"{len(sizes)} image sizes: each is calibrated as a camera of its own")
    flashes = sum(p.flash for p in photos)
    if not any(p.focal for p in photos):
        notes.append("no focal length in the files: it is estimated from the images alone")
    if flashes:
        notes.append(
            f"{flashes} of {len(photos)} photographs were taken with flash: "
            f"the lighting {'moves with the camera' if 2 * flashes > len(photos) else 'differs'}"
        )
    return photos, notes


def _read_folder(folder: Path, progress: Progress) -> tuple[list[Photo], list[str]]:
    try:
        files = sorted(p for p in folder.iterdir() if p.suffix.lower() in PHOTOGRAPHS and not p.name.startswith("."))
    except OSError as error:
        raise InputError(folder, f"cannot be read ({error.strerror}); check its permissions") from None
    if not files and (folder / "images").is_dir():
        return _read_folder(folder / "images", progress)
    if any(p.suffix.lower() in (".heic", ".heif") for p in files):
        optional_module("pillow_heif").register_heif_opener()
    notes, step = [], -(-len(files) // MOST_PHOTOS)
    if step > 1:
        notes.append(f"one of {step} photographs is read: {len(files[::step])} of {len(files)}")
        files = files[::step]
    taken = [name.casefold() for p in files for name in (p.stem, p.name)]
    photos, converted = [], list[str]()
    for k, path in enumerate(files):
        progress("reading", k, len(files))
        name = path.stem if taken.count(path.stem.casefold()) == 1 else path.name
        photos.append(_read_photo(path, name, converted))
    progress("reading", len(files), len(files))
    if converted:
        notes.append(f"{converted[0]}; {len(converted)} of {len(files)} such images")
    return photos, notes


def optional_module(module: str) -> ModuleType:
    """A module of the extra ``capture``; raises InputError with the command that installs it."""
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError:
        raise InputError(module, "is not installed: pip install 'reli3d[capture]'") from None


def _read_photo(path: Path, name: str, notes: list[str]) -> Photo:
    file_size(path)
    formats = (*FORMATS, *({"HEIF"} & Image.OPEN.keys()))
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)  # the limit is MAX_PIXELS
            image = Image.open(path, formats=formats)
        with image:
            if image.width * image.height > MAX_PIXELS:
                raise InputError(path, f"{TOO_LARGE}, got {image.width} x {image.height}; save it smaller")
            exif = image.getexif()
            tags = {**exif, **exif.get_ifd(ExifTags.IFD.Exif)}
            stored, exposure = image.size, exposure_data(image)
            image.draft("RGB", (LONGEST_SIDE, LONGEST_SIDE))
            upright = ImageOps.exif_transpose(image)
            check_depth(path, upright)
            upright = in_srgb(upright, path.name, notes)
            if upright.mode.startswith("I"):
                upright = Image.fromarray((np.asarray(upright) >> 8).astype(np.uint8))
            upright = upright.convert("RGBA" if upright.has_transparency_data else "RGB")
            upright.thumbnail((LONGEST_SIDE, LONGEST_SIDE), Image.Resampling.BOX, reducing_gap=None)
            alpha = alpha_values(upright, [])
            if alpha:  # on white: the hidden color is arbitrary, or shows what was removed
                upright = Image.composite(upright, Image.new("RGBA", upright.size, "white"), alpha)
            upright = upright.convert("RGB")
    except InputError:
        raise
    except Image.DecompressionBombError:
        raise InputError(path, f"{TOO_LARGE}; save it smaller") from None
    except Exception as error:  # decoders raise almost anything on a broken file
        raise InputError(path, f"cannot be decoded ({shown(str(error))}); leave it out or save it again") from None
    longest = max(upright.size)
    focal = focal_from_exif(tags, stored, longest)
    lens = (upright.size, str(tags.get(ExifTags.Base.Model, "")), round(focal) if focal else None)
    fired = int(_number(tags.get(ExifTags.Base.Flash), 0.0)) % 2 == 1  # the other bits say how it was set
    return Photo(name, np.asarray(upright), focal, lens, fired, np.asarray(alpha) if alpha else None, exposure)


def focal_from_exif(tags: dict, stored: tuple[int, int], longest: int) -> float | None:
    """Focal length in pixels of an image reduced to ``longest`` pixels along its longer side, or None.

    From FocalLength and FocalPlaneXResolution where both are there (Canon has no other), else from
    FocalLengthIn35mmFilm, which refers to a frame 36 mm wide.  stored: width and height of the file.
    """
    base = ExifTags.Base
    length = _number(tags.get(base.FocalLength), 0.0)
    density = _number(tags.get(base.FocalPlaneXResolution), 0.0)
    unit = MILLIMETERS.get(int(_number(tags.get(base.FocalPlaneResolutionUnit), 2.0)))
    taken = max(_number(tags.get(base.ExifImageWidth), 0.0), _number(tags.get(base.ExifImageHeight), 0.0), *stored)
    found = 0.0
    if length > 0 and density > 0 and unit:
        found = length / unit * density * longest / taken
    elif (film := _number(tags.get(base.FocalLengthIn35mmFilm), 0.0)) > 0:
        found = film / 36.0 * longest
    return found if 0.3 * longest < found < 20.0 * longest else None


def _number(value: object, default: float) -> float:
    try:
        return float(value)  # type: ignore[arg-type] # IFDRational, int, or something broken
    except (TypeError, ValueError, ZeroDivisionError):
        return default


def sharpness(pixels: np.ndarray) -> float:
    """Variance of the Laplacian of the luma at SHARPNESS_SIDE pixels, over the luma's variance; 0 for a plain image."""
    gray = cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY)
    scale = SHARPNESS_SIDE / max(gray.shape)
    if scale < 1.0:
        gray = cv2.resize(gray, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return float(cv2.Laplacian(gray, cv2.CV_32F).var() / max(float(gray.var()), 1.0))


def _read_video(path: Path, progress: Progress) -> tuple[list[Photo], list[str]]:
    """The sharpest frame of each of FRAME_COUNT windows of equal length."""
    av = optional_module("av")
    file_size(path)
    best: dict[int, tuple[float, np.ndarray]] = {}
    count, total, reason, hdr = 0, 0, "", list[str]()
    try:
        with av.open(str(path)) as file:
            if not file.streams.video:
                raise InputError(path, "expected a video, got a file without a video stream; check the path")
            stream = file.streams.video[0]
            stream.thread_type = "AUTO"
            total = stream.frames or round(float((file.duration or 0) / 1e6 * float(stream.average_rate or 30)))
            if not total:  # a stream without an index, such as a browser's WebM
                with av.open(str(path)) as again:
                    total = sum(1 for packet in again.demux(again.streams.video[0]) if packet.size)
            aspect = float(stream.sample_aspect_ratio or 1)
            if stream.codec_context.color_trc in HDR_TRANSFERS:
                hdr.append("the video is HDR: its colors are not converted and look pale; record in SDR")
            window = max(1.0, total / FRAME_COUNT)
            for frame in file.decode(stream):
                pixels = _frame_pixels(frame, aspect)
                score, at = sharpness(pixels), min(FRAME_COUNT - 1, int(count / window))
                if at not in best or score > best[at][0]:
                    best[at] = score, pixels
                count += 1
                progress("reading", min(count, total), total)
    except InputError:
        raise
    except Exception as error:  # FFmpeg's errors have many classes
        reason = shown(getattr(error, "strerror", None) or str(error))
    notes = [f"{len(best)} sharp frames taken of {count} of the video", *hdr]
    if count < WHOLE_VIDEO * total:  # FFmpeg ends without an error where a file is cut off
        notes.append(f"only {count} of the {total} frames of the video can be decoded: the file is cut off or broken")
        reason = reason or f"{count} of {total} frames: the file is cut off"
    if len(best) < FEWEST and reason:
        raise InputError(path, f"cannot be decoded ({reason}); record it again")
    return [Photo(f"frame_{k:04d}", best[k][1], None, (best[k][1].shape,)) for k in sorted(best)], notes


def _frame_pixels(frame, aspect: float) -> np.ndarray:
    """RGB of a decoded frame, upright, with square pixels, reduced to LONGEST_SIDE.  aspect: of a stored pixel."""
    width, height = frame.width * aspect, frame.height
    scale = min(1.0, LONGEST_SIDE / max(width, height))
    untagged = frame.colorspace == UNSPECIFIED and frame.height >= HD  # players assume BT.709, FFmpeg BT.601
    space = {"src_colorspace": "ITU709", "dst_colorspace": "ITU709"} if untagged else {}
    pixels = frame.reformat(round(width * scale), round(height * scale), "rgb24", **space).to_ndarray()
    turns = round(float(getattr(frame, "rotation", 0) or 0) / 90.0) % 4  # degrees counter-clockwise
    return np.ascontiguousarray(np.rot90(pixels, turns))
