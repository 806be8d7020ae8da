"""Holes, decimation, even remeshing and repair against known solids and real meshes."""

import math

import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial import cKDTree

from reli3d.geometry import remesh as module
from reli3d.geometry.holes import fill_holes, holes
from reli3d.geometry.mesh import Mesh, from_trimesh, report, volume
from reli3d.geometry.remesh import decimate, remesh, repair


def mesh_of(source):
    return from_trimesh(source)


def joined(*meshes):
    start = np.cumsum([0] + [len(m.vertices) for m in meshes])
    return Mesh(torch.cat([m.vertices for m in meshes]), torch.cat([m.faces + int(s) for m, s in zip(meshes, start)]))


def moved(mesh, x):
    return Mesh(mesh.vertices + torch.tensor([x, 0.0, 0.0]), mesh.faces)


def flipped(mesh):
    return Mesh(mesh.vertices, mesh.faces[:, [0, 2, 1]].contiguous())


def without(mesh, *rows):
    keep = torch.ones(len(mesh.faces), dtype=torch.bool)
    keep[list(rows)] = False
    return Mesh(mesh.vertices, mesh.faces[keep])


BOX = mesh_of(trimesh.creation.box((2.0, 1.0, 1.0)))
BALL = mesh_of(trimesh.creation.icosphere(subdivisions=3))
TUBE = mesh_of(trimesh.creation.cylinder(radius=1.0, height=2.0, sections=32))


def test_a_closed_surface_has_no_holes():
    assert holes(BALL) == [] and holes(BOX) == []
    assert holes(Mesh(torch.zeros(0, 3), torch.zeros(0, 3, dtype=torch.int32))) == []


def test_an_open_tube_has_two_round_holes_with_their_length_and_area():
    side = TUBE.vertices[TUBE.faces.long()][..., 2].abs().sum(1) > 2.99  # the caps lie at z = +-1
    level = TUBE.vertices[TUBE.faces.long()][..., 2]
    cap = side & (level.amax(1) == level.amin(1))
    tube = Mesh(TUBE.vertices, TUBE.faces[~cap])
    found = holes(tube)
    assert [len(h.vertices) for h in found] == [32, 32] and all(h.clean for h in found)
    for hole in found:  # of the regular polygon; float32 positions
        assert hole.length == pytest.approx(64 * math.sin(math.pi / 32), rel=1e-6)
        assert hole.area == pytest.approx(16 * math.sin(2 * math.pi / 32), rel=1e-6)
        at, following = tube.vertices[hole.vertices], tube.vertices[hole.vertices.roll(-1)]
        assert float((at - following).norm(dim=-1).max()) < 0.2  # in order around the border
    filled = fill_holes(tube)
    assert report(filled).watertight and report(filled).manifold
    assert float(volume(filled)) == pytest.approx(float(volume(TUBE)), rel=1e-6)
    assert len(holes(fill_holes(tube, max_edges=31))) == 2


def test_loops_follow_the_faces_and_fans_that_touch_keep_apart():
    ring = holes(without(BALL, 5))
    hole = [int(v) for v in ring[0].vertices]
    a, b, c = (int(v) for v in BALL.faces[5])
    assert set(hole) == {a, b, c} and hole.index(b) == (hole.index(a) + 2) % 3  # against the missing face
    one, two = (int(v) for v in (BALL.faces == BALL.faces[0, 0]).any(1).nonzero()[[0, 3], 0])
    bow = holes(without(BALL, one, two))  # two missing faces that touch in one vertex: one border around each fan
    assert sum(len(h.vertices) for h in bow) == 6
    assert report(fill_holes(without(BALL, 5))).manifold


def test_a_cut_along_a_triple_edge_is_not_clean():
    fin = Mesh(
        torch.cat([BOX.vertices, torch.tensor([[0.0, 3.0, 0.0]])]),
        torch.cat(
            [
                BOX.faces,
                torch.tensor([[int(BOX.faces[0, 0]), int(BOX.faces[0, 1]), len(BOX.vertices)]], dtype=torch.int32),
            ]
        ),
    )
    assert report(fin).nonmanifold_edges == 1 and any(not h.clean for h in holes(fin))


def test_filling_lets_gradients_through():
    vertices = BALL.vertices.clone().requires_grad_()
    open_ball = Mesh(vertices, without(BALL, *(BALL.faces == 3).any(1).nonzero()[:, 0].tolist()).faces)
    volume(fill_holes(open_ball)).backward()
    assert bool(torch.isfinite(vertices.grad).all()) and float(vertices.grad[0].norm()) > 0


@pytest.mark.parametrize("target", [100, 400])
def test_decimation_reaches_its_target_and_keeps_the_shape(target):
    pytest.importorskip("fast_simplification")
    ball = mesh_of(trimesh.creation.icosphere(subdivisions=4))
    for scale in (1e-3, 1.0, 1e3):
        got = decimate(Mesh(ball.vertices * scale, ball.faces), target)
        assert target - 4 <= len(got.faces) <= target
        r = report(got)
        assert r.watertight and r.euler == 2
        # a polyhedron of n faces with corners near the unit sphere loses about 8 / n of its volume
        assert abs(float(volume(got)) / scale**3 / float(volume(ball)) - 1) < 10 / target


def test_decimation_of_flat_faces_is_exact_and_borders_can_stay():
    pytest.importorskip("fast_simplification")
    box = trimesh.creation.box((2.0, 1.0, 1.0))
    for _ in range(3):
        box = box.subdivide()
    got = decimate(mesh_of(box), 60)
    assert float(volume(got)) == pytest.approx(2.0, rel=1e-5)
    x, y = np.meshgrid(np.linspace(0, 1, 17), np.linspace(0, 1, 17), indexing="ij")
    sheet = trimesh.Trimesh(
        np.stack([x, y, 0.1 * np.sin(5 * x)], -1).reshape(-1, 3),
        [[a, a + 17, a + 18] for i in range(16) for a in range(i * 17, i * 17 + 16)]
        + [[a, a + 18, a + 1] for i in range(16) for a in range(i * 17, i * 17 + 16)],
    )
    kept = holes(decimate(mesh_of(sheet), 200, keep_border=True))
    assert len(kept) == 1 and len(kept[0].vertices) == 64


def test_decimation_is_deterministic_and_leaves_small_meshes_alone():
    pytest.importorskip("fast_simplification")
    one, two = decimate(BALL, 200), decimate(BALL, 200)
    assert torch.equal(one.vertices, two.vertices) and torch.equal(one.faces, two.faces)
    assert len(decimate(BOX, 500).faces) == 12


def test_even_remeshing_gives_round_triangles():
    pytest.importorskip("pyacvd")
    got = remesh(TUBE, 600)
    assert abs(len(got.vertices) - 600) < 30 and report(got).euler == 2
    edge = got.vertices[got.faces.long()]
    length = (edge - edge.roll(1, 1)).norm(dim=-1)
    assert float(length.std() / length.mean()) < 0.3  # 0.16 measured on a torus; creases are rounded here
    distance, _ = cKDTree(
        trimesh.sample.sample_surface(trimesh.Trimesh(TUBE.vertices, TUBE.faces), 20000, seed=0)[0]
    ).query(got.vertices.numpy())
    assert distance.max() < 0.1  # under the size of a cluster


@pytest.mark.parametrize(
    "broken, want",
    [
        (without(BOX, 3), 2.0),
        (without(BALL, *range(40)), None),
        (flipped(BOX), 2.0),
        (joined(BOX, moved(BOX, 1.0)), 3.0),
        (joined(BOX, moved(flipped(BOX), 4.0)), 4.0),
        (joined(Mesh(BOX.vertices * 2, BOX.faces), flipped(BOX)), 14.0),
        (Mesh(BOX.vertices[BOX.faces.long().view(-1)], torch.arange(36, dtype=torch.int32).view(-1, 3)), 2.0),
        (Mesh(BOX.vertices, torch.cat([BOX.faces, BOX.faces[:1], BOX.faces[:1, [0, 0, 1]]])), 2.0),
    ],
    ids=["open", "torn", "inside out", "overlap", "one turned", "cavity", "soup", "repeated"],
)
def test_repair_gives_the_solid(broken, want):
    got = repair(broken)
    assert report(got).watertight and report(got).flipped_edges == 0
    if want is not None:
        assert float(volume(got)) == pytest.approx(want, rel=1e-5)


def test_repair_cuts_a_fin_off():
    fin = Mesh(
        torch.cat([BOX.vertices, torch.tensor([[0.0, 3.0, 0.0]])]),
        torch.cat(
            [
                BOX.faces,
                torch.tensor([[int(BOX.faces[0, 0]), int(BOX.faces[0, 1]), len(BOX.vertices)]], dtype=torch.int32),
            ]
        ),
    )
    assert report(repair(fin)).watertight


def test_repair_of_real_meshes(shared_data):
    for file in ("avocado", "boombox", "suzanne", "numeric_keypad"):
        source = mesh_of(trimesh.load(shared_data / "meshes" / f"{file}.glb", force="mesh"))
        got = repair(source)
        size = float((source.vertices.amax(0) - source.vertices.amin(0)).max())
        assert report(got).watertight, file
        distance, _ = cKDTree(source.vertices.numpy()).query(got.vertices.numpy())
        assert float(np.quantile(distance, 0.9)) < 0.02 * size, file  # most vertices are the old ones


@pytest.mark.parametrize(
    "call, name",
    [
        (lambda: decimate(BALL, 3), "faces"),
        (lambda: remesh(BALL, 7), "vertices"),
        (lambda: remesh(BALL, 70, subdivide=0), "subdivide"),
        (lambda: fill_holes(BALL, max_edges=2), "max_edges"),
        (
            lambda: repair(Mesh(torch.full((3, 3), float("nan")), torch.tensor([[0, 1, 2]], dtype=torch.int32))),
            "mesh.vertices",
        ),
        (lambda: repair(Mesh(torch.zeros(0, 3), torch.zeros(0, 3, dtype=torch.int32))), "mesh"),
        (lambda: repair(Mesh(torch.rand(3, 3), torch.tensor([[0, 1, 2]], dtype=torch.int32))), "mesh"),
    ],
)
def test_wrong_input_is_named(call, name):
    with pytest.raises(ValueError, match=f"^{name}: expected"):
        call()


def test_a_missing_library_is_named_in_one_line():
    with pytest.raises(ImportError, match=r"^no_such_mesh_library is not installed: pip install 'reli3d\[mesh\]'$"):
        module._library("no_such_mesh_library", "reli3d[mesh]")
