"""Files encoded while the preview renders equal those of the functions; after an error the old result remains."""

import base64
import re
from dataclasses import replace

import numpy as np
import pytest
import torch

from reli3d.io.glb import glb_bytes
from reli3d.output import results
from reli3d.output.folder import claimed
from reli3d.render.asset import Asset
from reli3d.render.lights import studio
from tests.support.rigs import sphere_views
from tests.support.scenes import ball_mesh, textures

RECORD = {"output_from_input": [1], "model_from_input": [2], "weights": {"file": "x"}}  # all of it in the mesh's extras
PREVIEW = np.zeros((8, 8, 3), np.uint8)
MOVED = (1.0, 2.0, 3.0)
VIEWS = sphere_views(count=1, size=(8, 8))


@pytest.fixture
def asset():
    return Asset(ball_mesh(2, 0.7), textures(16, "cpu", (0.6, 0.6, 0.6), 0.5), studio())


def written(folder, asset, **options):
    with claimed(folder, results.OURS) as replacing:
        files = results.encode(asset, VIEWS, RECORD, name="ball", **options)
        results.write_results(replacing, asset, *files, PREVIEW, {**RECORD, "object": "ball"})


@pytest.mark.parametrize("count", [1, 2])
def test_the_mesh_is_moved_and_the_page_shows_it_in_place(tmp_path, asset, threads, count):
    threads(count)
    written(tmp_path / "ball", asset, translation=MOVED)
    assert (tmp_path / "ball" / "mesh.glb").read_bytes() == glb_bytes(asset, extras=RECORD, translation=MOVED)
    (shown,) = re.findall(r'"glb": "([^"]*)"', (tmp_path / "ball" / "viewer.html").read_text())
    assert base64.b64decode(shown) == glb_bytes(asset, extras=RECORD)
    assert results.complete(tmp_path / "ball", tmp_path)


def test_the_page_of_a_refined_result_has_both(tmp_path, asset):
    start = replace(asset, mesh=ball_mesh(2, 0.6))
    written(tmp_path / "ball", asset, before=start)
    page = (tmp_path / "ball" / "viewer.html").read_text()
    shown = dict(re.findall(r'"name": "(after|before)", "glb": "([^"]*)"', page))
    assert base64.b64decode(shown["after"]) == glb_bytes(asset, extras=RECORD)
    assert base64.b64decode(shown["before"]) == glb_bytes(start)


@pytest.mark.parametrize("count", [1, 2])
def test_what_cannot_be_encoded_leaves_the_old_result(tmp_path, asset, threads, count):
    threads(count)
    folder = tmp_path / "ball"
    written(folder, asset)
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    broken = replace(asset, textures=replace(asset.textures, base_color=asset.textures.base_color * torch.nan))
    with pytest.raises(ValueError, match="base_color"):
        written(folder, broken)
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before
    assert [path.name for path in tmp_path.iterdir()] == ["ball"]
