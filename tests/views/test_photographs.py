"""Photographs as people have them: many kinds of files, large ones, turned ones, without cameras, without masks."""

import json
import re
import subprocess
import sys
import types

import numpy as np
import pytest
import torch
from PIL import Image

from reli3d.errors import InputError
from reli3d.geometry.camera import project
from reli3d.io.images import decode_image
from reli3d.views.folder import load_views
from reli3d.views.reduce import MAX_FULL_PIXELS, MAX_OBJECT_PIXELS, cut
from tests.support import hostile
from tests.support.hostile import pose


def capture(folder, width, height, box, *, exif=None, mask_at=None, **lens):
    """One photograph with a gradient, an object in ``box`` (x0, y0, x1, y1), and its mask."""
    pixels = np.full((height, width, 3), 60, np.uint8)
    pixels[..., 0] = np.arange(width) * 255 // width
    pixels[..., 1] = (np.arange(height) * 255 // height)[:, None]
    mask = np.zeros((height, width), np.uint8)
    mask[box[1] : box[3], box[0] : box[2]] = 255
    (folder / "masks").mkdir(parents=True)
    Image.fromarray(pixels).save(folder / "a.jpg", quality=95, **({} if exif is None else {"exif": exif}))
    Image.fromarray(mask if mask_at is None else mask_at(mask)).save(folder / "masks/a.png")
    frame = {"file_path": "a.jpg", "transform_matrix": pose(0.4)}
    data = {"fl_x": 1.2 * width, "frames": [frame], **lens}
    (folder / "transforms.json").write_text(json.dumps(data))
    return folder


@pytest.mark.parametrize("whole", [False, True])
def test_a_large_photograph_keeps_its_object_and_its_camera(tmp_path, whole):
    """A point of the world falls on the same color, whatever part of the image is kept."""
    width, height, box = 3001, 2000, (1200, 300, 2703, 1500)
    capture(tmp_path / "large", width, height, box, cx=1400.0, cy=1100.0)
    views = load_views(tmp_path / "large", whole=whole)
    image, mask = views.images[0], views.masks[0]
    assert any("more than" in note for note in views.notes)
    if whole:
        assert 0.99 * MAX_FULL_PIXELS < mask.numel() < 1.01 * MAX_FULL_PIXELS
    else:
        columns, rows = (mask > 0.5).any(0).nonzero(), (mask > 0.5).any(1).nonzero()
        side = max(int(columns[-1] - columns[0]), int(rows[-1] - rows[0])) + 1
        assert MAX_OBJECT_PIXELS - 2 <= side <= MAX_OBJECT_PIXELS
        assert max(mask.shape) <= 1.3 * MAX_OBJECT_PIXELS
    points = torch.tensor([[0.15, 0.1, 0.0], [0.5, 0.2, 0.1], [0.3, -0.1, -0.2]])
    full = torch.tensor([1.2 * width, 1.2 * width, 1400.0, 1100.0])
    at, _ = project(points, views.c2w[0], full)
    now, _ = project(points, views.c2w[0], views.intrinsics[0])
    for (x, y), (u, v) in zip(at.tolist(), now.tolist()):
        assert box[0] < x < box[2] and box[1] < y < box[3]
        color_of = image[int(v), int(u)] * 255
        # the gradient moves by 1/255 in 8 rows; JPEG and rounding cost two
        assert abs(float(color_of[0]) - x * 255 / width) < 3 and abs(float(color_of[1]) - y * 255 / height) < 3
        assert float(mask[int(v), int(u)]) == 1.0
    assert views.masks[0].dtype == torch.float32


def test_photographs_up_to_two_megapixels_stay_as_they_are():
    inside = np.ones((1080, 1920), bool)
    assert cut((1920, 1080), inside, whole=False) is None and cut((1920, 1080), inside, whole=True) is None
    small = cut((6000, 4000), np.pad(np.ones((9, 7), bool), ((10, 3981), (20, 5973))), whole=False)
    assert small.size == (small.part[2] - small.part[0], small.part[3] - small.part[1])  # nothing is made larger


def test_color_under_alpha_survives_the_reduction(tmp_path):
    pixels = np.full((1600, 1600, 4), (200, 100, 50, 0), np.uint8)
    pixels[200:1400, 200:1400, 3] = 255
    (tmp_path / "rgba").mkdir()
    Image.fromarray(pixels).save(tmp_path / "rgba/0.png", compress_level=1)
    frame = {"file_path": "rgba/0.png", "transform_matrix": pose(0.0), "camera_fov": 0.6}
    (tmp_path / "transforms.json").write_text(json.dumps({"frames": [frame]}))
    views = load_views(tmp_path)
    assert views.images[0].shape == (960, 960, 3)
    assert float((views.images[0] * 255 - torch.tensor([200.0, 100.0, 50.0])).abs().max()) < 1e-3


@pytest.mark.parametrize("w, h, turned", [(300, 400, True), (600, 800, True), (400, 300, False), (None, None, False)])
def test_exif_orientation_counts_where_the_cameras_were_calibrated_on_turned_images(tmp_path, w, h, turned):
    exif = Image.Exif()
    exif[0x0112] = 6  # the camera was turned: the first row of the file is the right side of the upright image
    lens = {} if w is None else {"w": w, "h": h, "cx": 140.0 * w / 300, "cy": 0.5 * h}
    upright = lambda mask: np.rot90(mask, -1) if turned else mask
    capture(tmp_path / "phone", 400, 300, (100, 50, 300, 250), exif=exif, mask_at=upright, **lens)
    views = load_views(tmp_path / "phone")
    note = next(n for n in views.notes if "EXIF orientation 6" in n)
    assert (" applied: " in note) == turned
    assert tuple(views.images[0].shape[:2]) == ((400, 300) if turned else (300, 400))
    top_right = views.images[0][2, -3] if turned else views.images[0][2, 2]
    assert float(top_right[:2].max()) < 0.05  # the first stored pixel


def test_a_large_mask_of_isolated_pixels_is_empty(tmp_path):
    folder = capture(tmp_path / "large", 3000, 2000, (750, 400, 2250, 1600))
    specks = np.zeros((2000, 3000), np.uint8)
    specks[100:1900:100, 150:2850:150] = 255
    Image.fromarray(specks).save(folder / "masks/a.png")
    with pytest.raises(InputError, match="mask that is empty"):
        load_views(folder)


@pytest.mark.parametrize("orientation", range(2, 9))
@pytest.mark.parametrize("compression", ["raw", "tiff_lzw"])
def test_the_orientation_of_a_tiff_is_not_applied_either(tmp_path, orientation, compression):
    exif = Image.Exif()
    exif[0x0112] = orientation
    pixels = hostile.random_image(alpha=False)[:24]
    Image.fromarray(pixels).save(tmp_path / "a.tif", exif=exif, compression=compression)
    notes = []
    assert np.array_equal(np.asarray(decode_image(tmp_path / "a.tif", notes=notes)), pixels)
    assert "not applied" in notes[0]
    if orientation > 4:  # sides exchanged, as in the camera file
        turned = decode_image(tmp_path / "a.tif", notes=notes, calibrated=(24, pixels.shape[1]))
        assert turned.size == (24, pixels.shape[1]) and " applied: " in notes[1]


def test_a_video_behind_a_photograph_is_no_scan(tmp_path):
    Image.fromarray(hostile.random_image(alpha=False)).save(tmp_path / "a.jpg", progressive=True)
    noise = np.random.default_rng(0).bytes(1 << 23)  # has the bytes of a scan's start about 128 times
    (tmp_path / "a.jpg").write_bytes((tmp_path / "a.jpg").read_bytes() + noise)
    assert decode_image(tmp_path / "a.jpg").size == (hostile.SIDE, hostile.SIDE)


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="the peak of a process is read from Linux' /proc")
def test_16_large_photographs_take_less_than_a_gibibyte(tmp_path):
    """Peak of a process that reads 16 photographs of 24 megapixels, and their masks."""
    folder = capture(tmp_path / "large", 6000, 4000, (1500, 800, 4500, 3200))
    data = json.loads((folder / "transforms.json").read_text())
    for i in range(16):
        (folder / f"{i}.jpg").hardlink_to(folder / "a.jpg")
        (folder / f"masks/{i}.png").hardlink_to(folder / "masks/a.png")
    data["frames"] = [{"file_path": f"{i}.jpg", "transform_matrix": pose(0.39 * i)} for i in range(16)]
    (folder / "transforms.json").write_text(json.dumps(data))
    peak = r"re.search(r'VmHWM:\s+(\d+)', open('/proc/self/status').read())[1]"
    code = (
        "import re, sys; from reli3d.views.folder import load_views; v = load_views(sys.argv[1]); "
        f"print(len(v), int({peak}) / 2**20)"
    )
    done = subprocess.run([sys.executable, "-c", code, str(folder)], capture_output=True, text=True, timeout=300)
    count, gibibytes = done.stdout.split()
    assert int(count) == 16
    assert float(gibibytes) < 1.0


def plain(folder):
    folder.mkdir(parents=True)
    for i in range(3):
        Image.fromarray(hostile.random_image(alpha=False)).save(folder / f"p {i}.jpg")
    return folder


def command(source):
    with pytest.raises(InputError) as caught:
        load_views(source)
    return str(caught.value)


def test_photographs_without_cameras_are_answered_with_the_command(tmp_path, monkeypatch):
    """In one line, with quoted names: photographs in a folder or its ``images``, a video, the parent of an album."""
    shoe = plain(tmp_path / "my shoe/images").parent
    line = f"got 3 photographs without; run: reli3d capture '{shoe}/images' '{shoe}-object'"
    assert line in command(shoe)
    flat = plain(tmp_path / "flat")
    assert f"reli3d capture {flat} {flat}-object" in command(flat)
    parent = tmp_path / "DCIM"
    album = plain(parent / "100APPLE")
    assert f"got 3 photographs in 100APPLE without; run: reli3d capture {album} {album}-object" in command(parent)
    video = tmp_path / "turn.MOV"
    video.write_bytes(b"video")
    assert f"got a video without; run: reli3d capture {video} {tmp_path}/turn-object" in command(video)
    (tmp_path / "clips").mkdir()
    video = video.rename(tmp_path / "clips/turn.mp4")
    assert f"reli3d capture {video} {tmp_path}/clips-object" in command(tmp_path / "clips")
    phone = tmp_path / "phone"
    phone.mkdir()
    for k in range(3):
        (phone / f"IMG_{k}.HEIC").write_bytes(b"photograph")
    assert f"reli3d capture {phone} {phone}-object" in command(phone)
    monkeypatch.chdir(tmp_path)
    assert "run: reli3d capture flat flat-object" in command("flat")
    monkeypatch.chdir(flat)
    assert "run: reli3d capture . ../flat-object" in command(".")
    capture(tmp_path / "objects/one", 400, 300, (100, 50, 300, 250))
    line = f"expected one object, got 1 folders of objects; give {tmp_path}/objects/one"
    assert line in command(tmp_path / "objects")
    (tmp_path / "empty").mkdir()
    assert "expected transforms.json or a COLMAP model" in command(tmp_path / "empty")
    (tmp_path / "empty/IMG_1.DNG").write_bytes(b"photograph")
    assert "IMG_1.DNG: expected JPEG, HEIC or PNG photographs; convert" in command(tmp_path / "empty")


def test_backgrounds_are_removed_on_request_alone(tmp_path, monkeypatch):
    folder = capture(tmp_path / "object", 400, 300, (100, 50, 300, 250))
    (folder / "masks/a.png").unlink()
    with pytest.raises(InputError, match="expected alpha or a foreground mask.*--remove-background"):
        load_views(folder)
    requested = []
    box = Image.new("L", (400, 300))
    box.paste(255, (110, 60, 290, 240))
    fake = types.SimpleNamespace(
        new_session=lambda name: requested.append(name) or "session", remove=lambda image, *, session, only_mask: box
    )
    monkeypatch.setitem(sys.modules, "rembg", fake)
    views = load_views(folder, remove_background=True)
    assert int(views.masks[0].sum()) == 180 * 180 and requested == ["isnet-general-use"]
    assert any(re.match("1 of 1 masks made by rembg", n) for n in views.notes)
    Image.fromarray(np.asarray(box)).save(folder / "masks/a.png")
    load_views(folder, remove_background=True)
    assert len(requested) == 1  # a mask that is there goes first, and no network is loaded
    (folder / "masks/a.png").unlink()
    fake.new_session = lambda name: (_ for _ in ()).throw(OSError("no route to\nhost"))
    with pytest.raises(InputError, match="expected the network isnet-general-use of rembg, got no route to"):
        load_views(folder, remove_background=True)
    monkeypatch.setitem(sys.modules, "rembg", None)  # as if it were not installed
    with pytest.raises(InputError, match=r"^remove-background: expected rembg installed.*reli3d\[masks\]"):
        load_views(folder, remove_background=True)
