"""Reading invalid files: an error that names the field, at once, and only ValueError and OSError."""

import base64
import io
import json
import os
import struct
import time
import tracemalloc

import numpy as np
import pytest
from PIL import Image

from reli3d.errors import InputError
from reli3d.io.glb import read_glb
from reli3d.io.hdr import read_environment, read_hdr_image
from reli3d.io.images import read_image
from reli3d.nn.presets import OFFICIAL, SMALL, from_json, to_json
from reli3d.nn.weights import WeightsError, read_manifest
from reli3d.views.folder import intrinsics_of
from reli3d.views.frames import Lens, nearest_rigid
from reli3d.views.transforms import read_json, read_transforms
from tests.support import gltf
from tests.support.networks import NANO

AT_ONCE = 5.0  # seconds of the processor: expected is less than one, against minutes


@pytest.fixture(autouse=True)
def at_once():
    began = time.process_time()
    yield
    assert time.process_time() - began < AT_ONCE


def transforms(folder, **fields):
    frame = {"file_path": "0.png", "transform_matrix": np.eye(4).tolist(), **fields}
    (folder / "transforms.json").write_text(json.dumps({"frames": [frame]}))
    return folder / "transforms.json"


@pytest.mark.parametrize(
    "word, fields",
    [
        ("w, h", {"w": 0.5, "h": 8, "fl_x": 9}),
        ("w, h", {"w": 8, "h": 1e-300, "fl_x": 9}),
        ("fov_rad", {"fov_rad": 5e-324}),
        ("camera_fov", {"camera_fov": [0.7, 5e-324]}),
        ("camera_angle_x", {"camera_angle_x": 1e-320}),
    ],
)
def test_lenses_that_divide_by_zero(tmp_path, word, fields):
    with pytest.raises(InputError, match=word):
        read_transforms(transforms(tmp_path, **fields))


def test_a_focal_length_next_to_nothing_with_distortion():
    with pytest.raises(InputError, match="distortion"):
        intrinsics_of(Lens(focal=(1e-100, 1e-100), radial=(0.1, 0.1, 0.1)), 64, 64, "here", [])


def test_a_skew_is_not_called_a_scale():
    matrix = np.eye(4)
    matrix[0, 1] = 0.0009  # with the scale below R^T R leaves 1 by more than is allowed, and without it by less
    matrix[0, 0] = 1.0006
    with pytest.raises(InputError, match="right angles"):
        nearest_rigid("here", "transform_matrix", matrix)
    with pytest.raises(InputError, match="got scale 1.01"):
        nearest_rigid("here", "transform_matrix", np.diag([1.01, 1.01, 1.01, 1.0]))


def test_many_keys_with_one_duplicate(tmp_path):
    path = tmp_path / "many.json"
    path.write_text("{" + ",".join(f'"{k}":0' for k in range(200_000)) + ',"199999":0}')
    with pytest.raises(InputError, match="'199999' twice"):
        read_json(path)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs pipes")
@pytest.mark.parametrize("read", [read_environment, read_hdr_image, read_image, read_glb, read_manifest, read_json])
def test_pipes_and_devices_are_not_opened(tmp_path, read):
    os.mkfifo(tmp_path / "pipe")
    for path in (tmp_path / "pipe", "/dev/zero", "/dev/stdin", tmp_path):
        with pytest.raises(ValueError, match="regular file"):
            read(path)


def test_a_file_without_permission_is_reported(tmp_path, monkeypatch):
    Image.new("RGB", (9, 9)).save(tmp_path / "a.png")

    def refuse(*_, **__):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Image, "open", refuse)  # also for root, who may read everything
    with pytest.raises(InputError, match="permissions"):
        read_image(tmp_path / "a.png")


def test_many_frames_are_not_counted(tmp_path):
    """A TIFF whose 20,000 directories follow each other; each has an entry of its own."""
    entries = [*((tag, 3, 1) for tag in (256, 257, 259, 262, 277, 278)), (258, 3, 8), (273, 4, 8), (279, 4, 1)]
    entries.sort()
    size = 2 + 12 * len(entries) + 4
    data = bytearray(b"II*\0" + struct.pack("<I", 16) + bytes(8))
    for k in range(20_000):
        data += struct.pack("<H", len(entries)) + b"".join(struct.pack("<HHII", t, f, 1, v) for t, f, v in entries)
        data += struct.pack("<I", 16 + (k + 1) * size if k < 19_999 else 0)
    (tmp_path / "many.tif").write_bytes(data)
    with pytest.raises(InputError, match="several frames"):
        read_image(tmp_path / "many.tif")
    Image.new("L", (16, 9), 77).save(tmp_path / "one.tif")
    assert read_image(tmp_path / "one.tif")[0].shape == (9, 16, 3)


def test_a_thousand_scans_are_refused_and_ten_are_not(tmp_path):
    image = Image.fromarray(np.random.default_rng(0).integers(0, 255, (64, 64, 3), dtype=np.uint8))
    image.save(tmp_path / "a.jpg", progressive=True)
    assert read_image(tmp_path / "a.jpg")[0].shape == (64, 64, 3)
    data = (tmp_path / "a.jpg").read_bytes()
    last = data.rindex(b"\xff\xda")
    many = data[:last] + data[last:-2] * 1000 + data[-2:]
    for filled in (many, many[:2] + b"\xff" + many[2:], many.replace(b"\xff\xda", b"\xff\xff\xda")):
        (tmp_path / "b.jpg").write_bytes(filled)  # markers may follow fill bytes
        with pytest.raises(InputError, match="scans"):
            read_image(tmp_path / "b.jpg")


def glb(path, **document):
    """A GLB of one triangle at the origin; ``document`` replaces fields of the root object."""
    binary = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], np.float32).tobytes()
    document = {
        "asset": {"version": "2.0"},
        "buffers": [{"byteLength": 36}],
        "bufferViews": [{"buffer": 0, "byteLength": 36}],
        "accessors": [{"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
        "nodes": [{"mesh": 0}],
        **document,
    }
    path.write_bytes(gltf.packed(document, binary))
    return path


def textured(size, **info):
    """The fields of a GLB whose material has one image of ``size``."""
    data = io.BytesIO()
    Image.new("RGB", size).save(data, "PNG")
    uri = "data:image/png;base64," + base64.b64encode(data.getvalue()).decode()
    material = {"normalTexture": {"index": 0, **info}}
    return {
        "images": [{"uri": uri}],
        "textures": [{"source": 0}],
        "materials": [material],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "material": 0}]}],
    }


def test_an_image_of_twenty_materials_is_decoded_once(tmp_path, monkeypatch):
    fields = textured((32, 32))
    fields["textures"] *= 20
    fields["materials"] = [{"normalTexture": {"index": k}, "name": str(k)} for k in range(20)]
    part = {"attributes": {"POSITION": 0, "TEXCOORD_0": 1}}
    fields["meshes"] = [{"primitives": [{**part, "material": k} for k in range(20)]}]
    place = {"bufferView": 0, "componentType": 5126}
    fields["accessors"] = [{**place, "count": 3, "type": "VEC3"}, {**place, "count": 3, "type": "VEC2"}]
    opened, real = [], Image.open
    monkeypatch.setattr(Image, "open", lambda *args, **options: opened.append(1) or real(*args, **options))
    assert len(read_glb(glb(tmp_path / "a.glb", **fields))) == 20 and len(opened) == 1


@pytest.mark.parametrize(
    "fields, word",
    [
        ({"extensionsRequired": [{}]}, "extensionsRequired"),
        ({"extensionsRequired": [["KHR"], 3]}, "extensionsRequired"),
        ({"nodes": [{"mesh": 0, "children": None}]}, "children"),
        ({"nodes": [7]}, "nodes"),
        ({"accessors": [{"componentType": 5126, "count": 60_000_000, "type": "VEC3"}]}, "count"),
        ({"nodes": [{"mesh": 0}] * 5000}, "primitives as placed"),
        ({"meshes": [{"primitives": [{"attributes": {"POSITION": 0}}] * 5000}]}, "primitives as placed"),
        (textured((30000, 1)), "made square"),
        (textured((8, 8), scale=1e308), "scale"),
        ({"meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "material": []}]}]}, "material"),
    ],
)
def test_glb_fields(tmp_path, fields, word):
    assert len(read_glb(glb(tmp_path / "good.glb"))) == 1
    with pytest.raises(InputError, match=word):
        read_glb(glb(tmp_path / "bad.glb", **fields))


@pytest.mark.parametrize(
    "change",
    [
        *({"shape": [value]} for value in (1.0, "1", True)),
        *({"data_offsets": value} for value in ([0.0, 4], ["0", "4"], [0, 1e400], [0])),
    ],
)
def test_headers_of_weights_hold_integers(tmp_path, change):
    header = json.dumps({"x": {"dtype": "F32", "shape": [1], "data_offsets": [0, 4], **change}}).encode()
    (tmp_path / "w").write_bytes(len(header).to_bytes(8, "little") + header + bytes(4))
    with pytest.raises(WeightsError):
        read_manifest(tmp_path / "w")


def test_texts_that_are_no_presets_are_refused():
    assert all(from_json(to_json(preset)) == preset for preset in (SMALL, OFFICIAL, NANO))
    no_name = to_json(SMALL).replace('"name": "small"', '"name": 5')
    for text in ("[" * 100_000, "{" * 100_000, '{"pyramid":' * 50_000, "1" * 10_000, "[]", "null", "", "{}", no_name):
        with pytest.raises(ValueError, match="preset"):
            from_json(text)


def test_a_chunk_that_claims_more_than_the_file_takes_no_memory(tmp_path):
    """Found by the campaign: Pillow reads the rest of the chunk after the last row, 4 GiB."""
    path = tmp_path / "a.png"
    Image.fromarray(np.full((32, 32, 4), 255, np.uint8)).save(path)
    data = path.read_bytes()
    at = data.index(b"IDAT") - 4
    path.write_bytes(data[:at] + struct.pack(">I", 2**32 - 1) + data[at + 4 :])
    tracemalloc.start()
    try:
        assert read_image(path)[0].shape == (32, 32, 3)
        assert tracemalloc.get_traced_memory()[1] < 1 << 24  # 16 MiB; the image has 4 KiB
    finally:
        tracemalloc.stop()
