"""Masks of images: which file belongs to which image, and what its pixel values mean."""

import itertools
import os
from collections import defaultdict
from collections.abc import Iterator, Sequence
from pathlib import Path, PurePath

import numpy as np
from PIL import Image, ImageChops

from reli3d.errors import InputError, shown
from reli3d.views.file_names import ENDINGS, FolderIndex, images_below, named
from reli3d.views.frames import Frame

FOLDERS = ("masks", "mask")
MIN_OPAQUE = 250 / 255  # from here on a value counts as white: networks and JPEG rarely reach 1
FEW_VALUES = 16  # up to which a mask has no noise of a codec, so that every value counts
NOISE_MARGIN = 16 / 255  # of values near black and white where there are more
MAX_FLAT_FRACTION = 0.2  # of the pixels between black and white, in flat 3x3 blocks; above it these are labels
MIN_PEAK_FRACTION = 0.3  # fraction of the object at the highest value, from which that value is its opaque part
GRAY_SPREAD = 16  # of 255: difference of channels up to which a pixel is gray; JPEG's chroma
MAX_COLORS = 4096
LABEL = "masks: the object has "
_TOP = {"L": 255.0, "F": 65535.0}


def mask_values(path: os.PathLike, bitmap: Image.Image, notes: list[str]) -> Image.Image:
    """The coverage of the object, mode L or F, that a mask file of ``decode_image`` holds.

    Alpha where it is used, else gray, or one color on black.  Gray values between black and white are coverage
    (antialiasing).  Of a mask with two values, black and one below white, nonzero is the object, with a note.  Raises
    InputError, with the values found, for several labels and for masks without black.
    """
    channel = used_alpha(bitmap) or (bitmap if bitmap.mode in _TOP else None)
    return _coverage(path, channel, notes) if channel else _color_coverage(path, bitmap.convert("RGB"), notes)


def alpha_values(bitmap: Image.Image, notes: list[str]) -> Image.Image | None:
    """The alpha of an image as coverage; None where it has none, or one that is opaque nearly everywhere.

    Of two values, 0 and one below white, nonzero is the object, with a note; so are many values about one.
    """
    alpha = used_alpha(bitmap)
    if alpha is None:
        return None
    grays = _gray_values(alpha)
    return _nonzero(alpha, grays[1], notes) if len(grays) == 2 and grays[0] == 0 else _scaled(alpha, grays, notes)


def used_alpha(bitmap: Image.Image) -> Image.Image | None:
    """The alpha channel of ``bitmap`` where it is below one half somewhere."""
    if bitmap.mode != "RGBA":
        return None
    alpha = bitmap.getchannel("A")
    return alpha if int(np.asarray(alpha).min()) < 128 else None


def _gray_values(channel: Image.Image) -> list[int]:
    """The values that occur, ascending."""
    if channel.mode == "L":
        return [value for value, count in enumerate(channel.histogram()) if count]
    return [int(v) for v in np.unique(np.asarray(channel).astype(np.uint16))]


def _nonzero(channel: Image.Image, value: int, notes: list[str]) -> Image.Image:
    """``channel``, of which ``value`` is the only value above 0, as 0 and 255."""
    if value >= MIN_OPAQUE * _TOP[channel.mode]:
        return channel
    return _labeled(channel, f"the value {value}", notes)


def _labeled(channel: Image.Image, label: str, notes: list[str]) -> Image.Image:
    notes.append(f"{LABEL}{label} instead of white; nonzero pixels are taken as the object")
    return Image.fromarray(np.where(np.asarray(channel) > 0, np.uint8(255), np.uint8(0)))


def check_one_label(folder: os.PathLike, notes: Sequence[str]) -> None:
    """Raises InputError where the notes of several masks name different values or colors of the object."""
    labels = sorted({note.removeprefix(LABEL).partition(" instead")[0] for note in notes if note.startswith(LABEL)})
    if len(labels) > 1:
        expected = f"expected one label in all masks, got {', '.join(labels[:4])}"
        raise InputError(folder, f"masks: {expected}; save masks of one object")


def _coverage(path: os.PathLike, channel: Image.Image, notes: list[str]) -> Image.Image:
    grays, top = _gray_values(channel), _TOP[channel.mode]
    if len(grays) == 1 and 0 < grays[0] < MIN_OPAQUE * top or len(grays) == 2 and grays[0] > 0:
        raise _not_a_mask(path, f"the values {', '.join(map(str, grays))} without 0")
    if len(grays) == 2:
        return _nonzero(channel, grays[1], notes)
    if len(grays) == 1:
        return channel
    values, peak, few = np.asarray(channel), grays[-1], len(grays) <= FEW_VALUES
    high = min(peak, MIN_OPAQUE * top) if few else (1 - NOISE_MARGIN) * min(peak, top)
    between = (values > (0 if few else NOISE_MARGIN * top)) & (values < high)
    flat = _flat(values)
    if int((between[1:-1, 1:-1] & flat).sum()) > MAX_FLAT_FRACTION * int(between.sum()):
        some = ", ".join(map(str, grays[:8])) + (", ..." if len(grays) > 8 else "")
        raise _not_a_mask(path, f"{len(grays)} values in flat areas ({some}), as of several labels")
    return _scaled(channel, grays, notes)


def _scaled(channel: Image.Image, grays: list[int], notes: list[str]) -> Image.Image:
    """``channel`` with the object opaque, and a note, if its highest is below white and most values lie near it."""
    peak, top = grays[-1], _TOP[channel.mode]
    if not 0 < peak < MIN_OPAQUE * top:
        return channel
    values = np.asarray(channel)
    upper, between = (int((values > part * peak).sum()) for part in (0.75, 0.25))
    if int(((values == peak)[1:-1, 1:-1] & _flat(values)).sum()) > MIN_PEAK_FRACTION * int((values > 0).sum()):
        white, which = peak, f"the highest value, {peak}, is"
    elif between - upper < 0.5 * upper:
        white = int(np.median(values[values > 0.5 * peak]))
        which = f"values about {white} are"
    else:
        return channel
    notes.append(f"masks: {which} taken as opaque instead of white")
    return Image.fromarray(np.rint(np.minimum(values * np.float32(255 / white), 255)).astype(np.uint8))


def _flat(values: np.ndarray) -> np.ndarray:
    """``(H - 2, W - 2)`` bool: whether all 8 neighbors have the pixel's value."""
    rows = (values[:, 1:-1] == values[:, :-2]) & (values[:, 1:-1] == values[:, 2:])
    middle = values[:, 1:-1]
    return rows[1:-1] & rows[:-2] & rows[2:] & (middle[1:-1] == middle[:-2]) & (middle[1:-1] == middle[2:])


def _color_coverage(path: os.PathLike, bitmap: Image.Image, notes: list[str]) -> Image.Image:
    """Coverage of ``bitmap``, which is gray or has multiples of one color alone, from its brightest channel."""
    red, green, blue = bitmap.split()
    high = ImageChops.lighter(ImageChops.lighter(red, green), blue)
    low = ImageChops.darker(ImageChops.darker(red, green), blue)
    if int(np.asarray(ImageChops.difference(high, low)).max()) <= GRAY_SPREAD:
        return _coverage(path, high, notes)
    colors = bitmap.getcolors(MAX_COLORS)
    if colors is None:
        raise _not_a_mask(path, f"more than {MAX_COLORS} colors")
    found = np.array(sorted(color for _, color in colors), dtype=np.float64)
    brightest = found[found.sum(1).argmax()]
    along = np.outer(found @ brightest / (brightest @ brightest), brightest)
    if np.abs(found - along).max() > GRAY_SPREAD:
        some = ", ".join(str(tuple(int(v) for v in color)) for color in found[:4])
        raise _not_a_mask(path, f"{len(found)} colors ({some}{', ...' if len(found) > 4 else ''})")
    if len(found) == 2 and not found[0].any():
        return _labeled(high, f"the color {tuple(int(v) for v in brightest)}", notes)
    return _coverage(path, high, notes)


def _not_a_mask(path: os.PathLike, got: str) -> InputError:
    return InputError(path, f"mask: expected the object white on black, got {got}; save one mask of this object")


class MaskFiles:
    """Finds the mask file of each of ``frames``, and never one file for two images.

    Below ``folder`` (else ``masks`` and ``mask`` in ``root``) a mask has the image's path relative to ``root``, or that
    path without its first one, two, ... folders, down to the bare file name.  It has the image's own ending, another
    one instead, or another one after it (COLMAP's ``a.jpg.png``).
    """

    def __init__(self, root: Path, frames: Sequence[Frame], folder: Path | None):
        self.given, self._root, self._index = folder, root, FolderIndex()
        self._folders = [folder] if folder is not None else [root / name for name in named(root, FOLDERS)]
        self._images: dict[str, dict[str, Path]] = defaultdict(dict)  # of each mask file, by their real paths
        images = list({os.path.realpath(frame.image): frame.image for frame in frames}.values())
        pairs = [(self._find(image), image) for image in (*images, *self._other_images(images))]
        for mask, image in (*pairs, *((frame.mask, frame.image) for frame in frames)):
            if mask is not None:
                self._images[os.path.realpath(mask)].setdefault(os.path.realpath(image), image)

    def _other_images(self, images: list[Path]) -> Iterator[Path]:
        """Images in nested folders that are no frames: a mask named after one of these may be another's."""
        frames = {(image.parent, image.stem) for image in images}  # the same photograph in another format
        tops = {part.parts[0] for part in map(self._relative, images) if len(part.parts) > 2}
        for top in sorted(tops):
            yield from (p for p in images_below(self._root / top) if (p.parent, p.stem) not in frames)

    def _relative(self, image: Path) -> PurePath:
        try:
            return Path(os.path.normpath(image)).relative_to(os.path.normpath(self._root))
        except ValueError:
            return PurePath(image.name)

    def _find(self, image: Path) -> Path | None:
        relative = self._relative(image)
        endings = [e for ending in ENDINGS for e in (ending, ending.upper())]
        names = (image.name, *(stem + ending for stem in (image.stem, image.name) for ending in endings))
        parts = [relative.parts[first:-1] for first in range(len(relative.parts))]
        places = itertools.product(self._folders, parts, dict.fromkeys(names))
        found = (self._index.find(folder, PurePath(*part, name)) for folder, part, name in places)
        return next((path for path in found if path is not None and os.path.isfile(path)), None)

    def of(self, frame: Frame) -> Path | None:
        """The mask file of ``frame``: given, its own, or found by name; InputError if it is another image's as well."""
        mask = self._find(frame.image) if self.given or frame.mask is None else frame.mask
        if mask is None:
            return None
        images = [self._relative(path).as_posix() for path in self._images[os.path.realpath(mask)].values()]
        if len(images) > 1:
            first, second, *_ = images
            got = f"that of {shown(first)} and {shown(second)}"
            raise InputError(mask, f"expected the mask of one image, got {got}; put masks into sub-folders as images")
        return mask
