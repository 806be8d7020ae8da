"""Decimation against known solids."""

import sys

import pytest
import torch
import trimesh

from reli3d.geometry.decimate import decimate
from reli3d.geometry.mesh import Mesh, report
from tests.support.meshes import mesh_from, volume

BOX = mesh_from(trimesh.creation.box((2.0, 1.0, 1.0)))
BALL = mesh_from(trimesh.creation.icosphere(subdivisions=3))


@pytest.mark.parametrize("target", [100, 400])
def test_decimation_reaches_its_target_and_keeps_the_shape(target):
    pytest.importorskip("fast_simplification")
    ball = mesh_from(trimesh.creation.icosphere(subdivisions=4))
    for scale in (1e-3, 1.0, 1e3):
        got = decimate(Mesh(ball.vertices * scale, ball.faces), target)
        assert target - 4 <= len(got.faces) <= target
        r = report(got)
        assert r.watertight and r.euler == 2
        # a polyhedron of n faces with corners near the unit sphere loses about 8 / n of its volume
        assert abs(volume(got) / scale**3 / volume(ball) - 1) < 10 / target


def test_decimation_of_flat_faces_is_exact():
    pytest.importorskip("fast_simplification")
    box = trimesh.creation.box((2.0, 1.0, 1.0))
    for _ in range(3):
        box = box.subdivide()
    got = decimate(mesh_from(box), 60)
    assert volume(got) == pytest.approx(2.0, rel=1e-5)


def test_decimation_is_deterministic_and_leaves_small_meshes_alone():
    pytest.importorskip("fast_simplification")
    one, two = decimate(BALL, 200), decimate(BALL, 200)
    assert torch.equal(one.vertices, two.vertices) and torch.equal(one.faces, two.faces)
    assert len(decimate(BOX, 500).faces) == 12


def test_wrong_input_is_named():
    corner = torch.tensor([[0, 1, 2]], dtype=torch.int32)
    for call, name in (
        (lambda: decimate(BALL, 3), "faces"),
        (lambda: decimate(Mesh(torch.full((3, 3), float("nan")), corner), 8), "mesh.vertices"),
    ):
        with pytest.raises(ValueError, match=f"^{name}: expected"):
            call()


def test_a_missing_library_is_named_in_one_line(monkeypatch):
    monkeypatch.setitem(sys.modules, "fast_simplification", None)
    with pytest.raises(ImportError, match=r"^fast_simplification is not installed: pip install 'reli3d\[mesh\]'$"):
        decimate(BALL, 100)
