"""Mask files: what their values mean, and which belongs to which image."""

import json

import numpy as np
import pytest
from PIL import Image

from reli3d.errors import InputError
from reli3d.views.folder import load_views
from tests.support import hostile

SIDE = 48
DISK = np.hypot(*(np.mgrid[:SIDE, :SIDE] - 23.5)) < 15


def antialiased(side=SIDE, radius=15.0):
    """Coverage of a disk by each pixel, of 8 x 8 samples."""
    fine = np.hypot(*(np.mgrid[: 8 * side, : 8 * side] / 8 - (side / 2 - 1 / 16))) < radius
    return fine.reshape(side, 8, side, 8).mean((1, 3))


def folder(root, images, **top):
    """A folder of these image files without alpha, a camera for each."""
    frames = []
    for k, name in enumerate(images):
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(np.full((SIDE, SIDE, 3), 90 + k, np.uint8)).save(root / name)
        frames.append({"file_path": name, "transform_matrix": hostile.pose(2.1 * k), "camera_fov": 0.6})
    (root / "transforms.json").write_text(json.dumps({**top, "frames": frames}))


def palette(labels, colors):
    bitmap = Image.fromarray(labels.astype(np.uint8), "L").convert("P")
    bitmap.putdata(labels.ravel().tolist())
    bitmap.putpalette([v for color in colors for v in color] + [0] * (768 - 3 * len(colors)))
    return bitmap


def mask_of(tmp_path, bitmap, place="masks/a.png", **options):
    """The mask and notes of one view whose mask file, or image, is ``bitmap``."""
    folder(tmp_path, ["images/a.png"])
    (tmp_path / "masks").mkdir()
    bitmap = Image.fromarray(bitmap) if isinstance(bitmap, np.ndarray) else bitmap
    bitmap.save(tmp_path / place, **options)
    views = load_views(tmp_path)
    return views.masks[0].numpy(), views.notes


def as_alpha(values):
    """An image of one color with this alpha."""
    return np.dstack([np.full((SIDE, SIDE, 3), 90, np.uint8), values])


DAVIS = [(0, 0, 0), (128, 0, 0), (0, 128, 0), (128, 128, 0), (0, 0, 128)]
TWO_VALUES = {
    "white": lambda: np.where(DISK, 255, 0).astype(np.uint8),
    "label 1": lambda: DISK.astype(np.uint8),
    "label 38": lambda: np.where(DISK, 38, 0).astype(np.uint8),
    "label 128": lambda: np.where(DISK, 128, 0).astype(np.uint8),
    "1 bit": lambda: DISK,
    "16 bit, white": lambda: np.where(DISK, 65535, 0).astype(np.uint16),
    "16 bit, label 1": lambda: DISK.astype(np.uint16),
    "16 bit, value 255": lambda: np.where(DISK, 255, 0).astype(np.uint16),
    "DAVIS entry 1": lambda: palette(DISK.astype(np.uint8), DAVIS),
    "DAVIS entry 3": lambda: palette(np.where(DISK, 3, 0), DAVIS),
    "palette, white first": lambda: palette(np.where(DISK, 0, 1), [(255, 255, 255), (0, 0, 0)]),
    "RGB, one color": lambda: np.where(DISK[..., None], (20, 90, 200), 0).astype(np.uint8),
    "gray and alpha": lambda: Image.merge(
        "LA", [Image.new("L", (SIDE, SIDE), 77), Image.fromarray(np.where(DISK, 255, 0).astype(np.uint8))]
    ),
    "white on black, opaque": lambda: Image.fromarray(np.where(DISK, 255, 0).astype(np.uint8)).convert("RGBA"),
    "label in alpha": lambda: as_alpha(DISK.astype(np.uint8)),
    "label in alpha of the image": lambda: as_alpha(DISK.astype(np.uint8)),
}


@pytest.mark.parametrize("name", TWO_VALUES)
def test_of_two_values_nonzero_is_the_object(tmp_path, name):
    mask, notes = mask_of(tmp_path, TWO_VALUES[name](), "images/a.png" if "of the image" in name else "masks/a.png")
    np.testing.assert_array_equal(mask, DISK.astype(np.float32))
    plain = name in ("white", "1 bit", "16 bit, white", "palette, white first", "gray and alpha")
    assert any("nonzero pixels are taken as the object" in n for n in notes) != (plain or "opaque" in name)


@pytest.mark.parametrize("steps", [255, 16, 4])
def test_gray_edges_are_coverage(tmp_path, steps):
    """Antialiased in many or in few steps."""
    stored = np.rint(np.rint(antialiased() * steps) / steps * 255).astype(np.uint8)
    mask, notes = mask_of(tmp_path, stored)
    np.testing.assert_array_equal(mask, stored / np.float32(255))
    assert not any("mask" in n for n in notes)


def test_gray_edges_of_a_label_are_scaled(tmp_path):
    """An antialiased label 38; 16 bits with the values of 8."""
    for k, (top, kind) in enumerate(((38, np.uint8), (255, np.uint16))):
        stored = np.rint(antialiased() * top)
        mask, notes = mask_of(tmp_path / str(k), stored.astype(kind))
        np.testing.assert_allclose(mask, stored / top, rtol=0, atol=0.51 / 255)  # rounded to 8 bits
        assert any(f"the highest value, {top}, is taken as opaque" in n for n in notes)


@pytest.mark.parametrize("ending, color", [(".jpg", (128, 0, 0)), (".webp", (128, 128, 128))])
def test_labels_of_a_lossy_codec_are_opaque(tmp_path, ending, color):
    mask, notes = mask_of(tmp_path, np.where(DISK[..., None], color, 0).astype(np.uint8), f"masks/a{ending}")
    assert ((mask > 0.5) != DISK).mean() < 0.01  # blocks of color at the edge
    inner = np.hypot(*(np.mgrid[:SIDE, :SIDE] - 23.5)) < 9  # clear of the blocks at the edge
    assert mask[inner].min() > 0.9 and any("taken as opaque" in n for n in notes)


def test_masks_of_jpeg_are_coverage(tmp_path):
    for quality in (95, 60, 20):
        stored = Image.fromarray(np.rint(antialiased() * 255).astype(np.uint8))
        mask, _ = mask_of(tmp_path / str(quality), stored, "masks/a.jpg", quality=quality)
        assert float(np.abs(mask - antialiased()).mean()) < 0.03  # the codec's ringing; a wrong scale gives 0.3


REFUSED = {
    "two labels": (lambda: np.where(DISK, 1, 0).astype(np.uint8) + (np.arange(SIDE) > 23) * DISK, "0, 1, 2"),
    "labels and a void border": (lambda: np.where(DISK, 1, 255 * (np.arange(SIDE) > 40)).astype(np.uint8), "0, 1, 255"),
    "no black": (lambda: np.where(DISK, 2, 1).astype(np.uint8), "1, 2"),
    "video range": (lambda: np.where(DISK, 235, 16).astype(np.uint8), "16, 235"),
    "one label everywhere": (lambda: np.full((SIDE, SIDE), 7, np.uint8), "7 without 0"),
    "many labels": (lambda: np.kron(np.arange(36).reshape(6, 6) * 7, np.ones((8, 8))).astype(np.uint8), "36 values"),
    "two DAVIS entries": (lambda: palette(DISK + 1 * (np.arange(SIDE) > 23) * DISK, DAVIS), "(0, 128, 0), (128, 0, 0)"),
    "16-bit labels": (lambda: (DISK * (300 + 7 * (np.arange(SIDE) > 23))).astype(np.uint16), "0, 300, 307"),
    "colored background": (lambda: np.where(DISK[..., None], (255, 0, 0), 255).astype(np.uint8), "(255, 255, 255)"),
    "a photograph": (lambda: np.random.default_rng(0).integers(0, 255, (SIDE, SIDE, 3), dtype=np.uint8), "colors"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_cannot_be_interpreted_is_refused_with_the_values(tmp_path, name):
    make, words = REFUSED[name]
    with pytest.raises(InputError) as caught:
        mask_of(tmp_path, make())
    assert "masks/a.png: mask: expected the object white on black, got" in str(caught.value)
    assert words in str(caught.value)


@pytest.mark.parametrize("second, words", [(2, "the value 2"), (DAVIS, "the color")])
def test_masks_of_different_labels_are_refused(tmp_path, second, words):
    folder(tmp_path, ["a.png", "b.png"])
    (tmp_path / "masks").mkdir()
    Image.fromarray(DISK.astype(np.uint8)).save(tmp_path / "masks/a.png")
    other = palette(3 * DISK, DAVIS) if second is DAVIS else Image.fromarray(2 * DISK.astype(np.uint8))
    other.save(tmp_path / "masks/b.png")
    with pytest.raises(InputError, match=f"expected one label in all masks, got .*{words}"):
        load_views(tmp_path)


@pytest.mark.parametrize("where", ["alpha", "mask", "gray alpha of a mask"])
@pytest.mark.parametrize("spread", [2, 4, 9])
def test_values_about_one_gray_are_opaque(tmp_path, where, spread):
    """Few or many values about 200, as of a lossy codec."""
    noise = np.random.default_rng(0).integers(200 - spread, 201 + spread, (SIDE, SIDE))
    gray = np.where(DISK, noise, 0).astype(np.uint8)
    if where == "alpha":
        mask, notes = mask_of(tmp_path, as_alpha(gray), "images/a.png")
    else:
        mask, notes = mask_of(tmp_path, gray if where == "mask" else Image.fromarray(as_alpha(gray)).convert("LA"))
    np.testing.assert_allclose(mask, DISK, rtol=0, atol=0.05)  # 191 of 200
    assert any("masks: values about 200 are taken as opaque instead of white" in n for n in notes)


def test_soft_alpha_is_coverage(tmp_path):
    """A fading edge that nowhere is quite opaque."""
    soft = np.rint(240 * np.clip(1.5 - np.hypot(*(np.mgrid[:SIDE, :SIDE] - 23.5)) / 15, 0, 1)).astype(np.uint8)
    soft = np.minimum(soft, 240 - (np.indices(soft.shape).sum(0) % 40).astype(np.uint8))
    np.testing.assert_array_equal(mask_of(tmp_path, as_alpha(soft), "images/a.png")[0], soft / np.float32(255))


def disk(k):
    """Disks of different areas, one for each mask."""
    return np.where(np.hypot(*(np.mgrid[:SIDE, :SIDE] - 23.5)) < 8 + k, 255, 0).astype(np.uint8)


def check_disks(views):
    assert [int(mask.sum()) for mask in views.masks] == [int((disk(k) > 0).sum()) for k in range(len(views))]


def put(root, names):
    for k, name in enumerate(names):
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(disk(k)).save(root / name)


NESTED = ["images/front/0.png", "images/back/0.png", "images/front/1.png"]
LAYOUTS = {
    "mirrored from the root": ["masks/images/front/0.png", "masks/images/back/0.png", "masks/images/front/1.png"],
    "another ending": ["masks/front/0.tif", "masks/back/0.tif", "masks/front/1.tif"],
    "folder mask": ["mask/front/0.png", "mask/back/0.png", "mask/front/1.png"],
    "given": ["given/front/0.png", "given/back/0.png", "given/front/1.png"],
}


@pytest.mark.parametrize("name", LAYOUTS)
def test_masks_mirror_the_folders_of_the_images(tmp_path, name):
    folder(tmp_path, NESTED)
    put(tmp_path, LAYOUTS[name])
    check_disks(load_views(tmp_path, masks=tmp_path / "given" if name == "given" else None))


def test_names_are_found_in_other_cases(tmp_path):
    folder(tmp_path, ["images/IMG_1.JPG", "images/img_2.jpg"])
    put(tmp_path, ["Masks/img_1.png", "Masks/IMG_2.PNG"])
    check_disks(load_views(tmp_path))
    data = json.loads((tmp_path / "transforms.json").read_text())
    data["frames"][0]["file_path"] = "Images/img_1.jpg"
    (tmp_path / "transforms.json").write_text(json.dumps(data))
    check_disks(load_views(tmp_path))


@pytest.mark.parametrize("listed", [NESTED[:2], NESTED[:1]])
def test_one_mask_is_never_that_of_two_images(tmp_path, listed):
    """Also where the camera file lists but one of the images that the mask is named after."""
    folder(tmp_path, NESTED[:2])
    folder(tmp_path, listed)
    put(tmp_path, ["masks/0.png"])
    with pytest.raises(InputError, match=r"masks/0.png: expected the mask of one image, got that of 'images/"):
        load_views(tmp_path)
    (tmp_path / "images/back/0.png").rename(tmp_path / "images/back/5.png")
    folder(tmp_path, NESTED[:1])
    assert len(load_views(tmp_path)) == 1  # nothing else is named so


def test_a_mask_path_is_never_that_of_two_images(tmp_path):
    folder(tmp_path, ["a.png", "b.png"])
    put(tmp_path, ["m.png"])
    text = (tmp_path / "transforms.json").read_text()
    (tmp_path / "transforms.json").write_text(text.replace('"file_path"', '"mask_path": "m.png", "file_path"'))
    with pytest.raises(InputError, match="m.png: expected the mask of one image, got that of 'a.png' and 'b.png'"):
        load_views(tmp_path)


def test_a_mask_that_links_out_of_the_folder_is_named(tmp_path):
    folder(tmp_path / "in", ["a.png"])
    put(tmp_path, ["outside.png"])
    (tmp_path / "in" / "masks").mkdir()
    (tmp_path / "in" / "masks" / "a.png").symlink_to(tmp_path / "outside.png")
    with pytest.raises(InputError, match="mask: expected a file within the folder"):
        load_views(tmp_path / "in")


def test_images_that_differ_in_their_ending_have_a_mask_each(tmp_path):
    folder(tmp_path, ["a.png", "a.jpg"])
    put(tmp_path, ["masks/a.png"])
    with pytest.raises(InputError, match="expected the mask of one image"):
        load_views(tmp_path)
    put(tmp_path, ["masks/a.png.png", "masks/a.jpg.png"])
    (tmp_path / "masks/a.png").unlink()
    check_disks(load_views(tmp_path))
