"""GLB files of shapes alone as training objects: combined, rounded, with procedural materials."""

import numpy as np
import pytest
import torch
import trimesh
from safetensors.torch import load_file

from reli3d.errors import InputError
from reli3d.synthetic import shapes
from reli3d.synthetic.shapes import ShapeSurface, combine, rounded
from tests.support.stages import rendered_sample, write_maps


@pytest.fixture
def files(tmp_path):
    trimesh.creation.box((1.0, 0.4, 0.2)).export(tmp_path / "box.glb")
    trimesh.creation.cylinder(0.3, 0.8).export(tmp_path / "cylinder.glb")
    return tmp_path / "box.glb", tmp_path / "cylinder.glb"


def test_combined_shapes_have_unit_size_and_a_material_for_each_part(files):
    parts = set()
    for seed in range(12):
        surface, again = (ShapeSurface(files, np.random.default_rng(seed)) for _ in range(2))
        assert torch.equal(surface.vertices, again.vertices) and torch.equal(surface.faces, again.faces)
        low, high = surface.vertices.amin(0), surface.vertices.amax(0)
        assert float((high - low).max()) == pytest.approx(1.0, abs=1e-5)
        assert float((high + low).abs().max()) < 1e-5
        shape = surface.shape
        assert len(shape.part) == len(shape.faces) and set(shape.part) == set(range(len(shape.materials)))
        parts.add(len(shape.materials))
        far = torch.tensor([[2.0, 0.0, 0.0]])
        assert 1.4 < float(surface.distance(far)) < 2.0
    assert {1, 2} <= parts  # one shape, and several


def test_subdivided_faces_keep_the_part_of_their_face():
    box = trimesh.creation.box()
    part = np.abs(box.face_normals).argmax(1)
    v, f, p = rounded(box.vertices, box.faces, part, 2, 0.0)
    normals = np.abs(trimesh.Trimesh(v, f, process=False).face_normals)
    assert len(f) == 16 * len(box.faces) and (normals.argmax(1) == p).all() and normals.max(1).min() > 1 - 1e-9
    smooth = trimesh.Trimesh(*rounded(box.vertices, box.faces, part, 2, 1.0)[:2], process=False)
    assert smooth.is_watertight and 0.3 < smooth.volume < 0.9


def test_too_many_faces_are_refused(files, monkeypatch):
    monkeypatch.setattr(shapes, "MAX_FACES", 11)
    with pytest.raises(InputError, match="--shapes: expected at most 11 faces of .*box.glb"):
        combine(files[:1], np.random.default_rng(0))


def test_a_sample_of_shapes_knows_its_finish(files, tmp_path):
    sample = load_file(rendered_sample(tmp_path / "out", write_maps(tmp_path), views=2, size=32, shapes=files))
    assert sample["finish_known"].tolist() == [1, 1]
