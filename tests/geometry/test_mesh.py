"""Mesh type, normals, components and report against closed forms and trimesh."""

import numpy as np
import pytest
import torch
import trimesh

from reli3d.geometry import mesh as module
from reli3d.geometry import topology
from reli3d.geometry.mesh import (
    Mesh,
    face_components,
    largest_components,
    select_faces,
    vertex_normals,
    watertight,
    weld,
    without_degenerate_faces,
)
from tests.support.meshes import mesh_from, volume


def report(mesh):
    found = module.report(mesh)
    assert watertight(mesh) is found.watertight  # the direct test agrees
    return found


def joined(*sources):
    return mesh_from(trimesh.util.concatenate(sources))


def test_unused_and_flat_vertices_get_a_unit_normal_without_gradient():
    vertices = torch.tensor([[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [5, 5, 5]]).requires_grad_()
    normals = vertex_normals(vertices, torch.tensor([[0, 1, 2]], dtype=torch.int32))
    assert normals.tolist() == [[0.0, 0.0, 1.0]] * 4
    assert bool((torch.autograd.grad(normals.sum(), vertices)[0] == 0).all())


def test_weld_groups_equal_positions_in_order():
    vertices = torch.tensor([[1.0, 2, 3], [0, 0, 0], [1, 2, 3], [-0.0, 0, 0], [1, 2, 3.0000002]])
    first, label = weld(vertices)
    assert first.tolist() == [0, 1, 4]
    assert label.tolist() == [0, 1, 0, 1, 2]


@pytest.mark.parametrize("columns", [1, 3, 8])
def test_rows_are_welded_as_numpy_does_even_where_all_hashes_collide(monkeypatch, columns):
    rows = np.random.default_rng(0).integers(0, 2 if columns == 8 else 4, (500, columns)).astype(np.float32)
    _, index, inverse = np.unique(rows, axis=0, return_index=True, return_inverse=True)
    lowest = index[inverse.reshape(-1)]
    assert all(len(part) == 0 for part in topology.weld_rows(rows[:0]))
    for _ in range(2):
        first, label = topology.weld_rows(rows)
        assert np.array_equal(first, np.unique(lowest)) and np.array_equal(first[label], lowest)
        monkeypatch.setattr(topology, "group", lambda keys: (np.arange(len(keys)), np.zeros(1, np.int64)))


@pytest.mark.parametrize(
    "source, euler",
    [(trimesh.creation.icosphere(2), 2), (trimesh.creation.torus(1.0, 0.3), 0), (trimesh.creation.box(), 2)],
)
def test_closed_surfaces_and_their_euler_number(source, euler):
    got = report(mesh_from(source))
    assert got.watertight and got.manifold
    assert (got.euler, got.components, got.faces) == (euler, 1, len(source.faces))
    soup = source.copy()
    soup.unmerge_vertices()  # three vertices a face: the welded mesh is the same
    again = report(mesh_from(soup))
    assert again.vertices == 3 * len(source.faces)
    assert (again.euler, again.watertight, again.manifold) == (euler, True, True)
    assert again.welded_vertices == len(source.vertices)


def test_defects_are_counted():
    cap = mesh_from(trimesh.creation.icosphere(1))
    opened = report(select_faces(cap, torch.arange(80) > 0))
    assert (opened.boundary_edges, opened.watertight, opened.manifold) == (3, False, True)
    flipped = cap.faces.clone()
    flipped[0] = flipped[0].flip(0)
    got = report(Mesh(cap.vertices, flipped))
    assert (got.flipped_edges, got.manifold, got.watertight) == (3, False, True)
    two = [trimesh.creation.box(), trimesh.creation.box().apply_translation([1, 1, 1])]  # meet in a corner
    got = report(joined(*two))
    assert (got.nonmanifold_vertices, got.nonmanifold_edges, got.components) == (1, 0, 1)
    # two tetrahedra with a common edge
    v = torch.tensor([[0.0, 0, 0], [0, 0, 1], [1, 0, 0], [1, 1, 0], [-1, 0, 0], [-1, -1, 0]])
    tetra = [[0, 2, 1], [0, 3, 2], [0, 1, 3], [1, 2, 3], [0, 4, 1], [0, 5, 4], [0, 1, 5], [1, 4, 5]]
    got = report(Mesh(v, torch.tensor(tetra, dtype=torch.int32)))
    assert (got.nonmanifold_edges, got.watertight, got.manifold) == (1, True, False)
    got = report(Mesh(v, torch.tensor([[0, 0, 1], [0, 1, 2]], dtype=torch.int32)))
    assert (got.degenerate_faces, got.boundary_edges, got.faces) == (1, 3, 2)


def test_components_and_the_largest():
    big, small = trimesh.creation.icosphere(3), trimesh.creation.icosphere(1).apply_translation([3, 0, 0])
    mesh = joined(small, big)
    label = face_components(mesh)
    assert label.tolist() == [0] * 80 + [1] * 1280
    kept = largest_components(mesh, 0.1).with_normals()
    assert (len(kept.faces), len(kept.vertices)) == (1280, 642)
    assert len(largest_components(mesh, 0.01).faces) == 1360
    assert len(largest_components(mesh, 1.0).faces) == 1280  # the largest stays whatever the fraction
    assert abs(volume(kept) - big.volume) < 1e-4  # float32 sum of 1280 terms around 3e-3


def test_faces_with_two_corners_at_one_position_are_removed():
    """An edge of zero length: its two faces are removed, its ends become one vertex, and the surface stays closed."""
    ball = mesh_from(trimesh.creation.icosphere(1))
    a, b = ball.faces[0, :2].long()
    vertices = ball.vertices.clone()
    vertices[b] = vertices[a]
    broken = Mesh(vertices, ball.faces)
    assert report(broken).degenerate_faces == 2
    found = report(without_degenerate_faces(broken))
    assert found.vertices == found.welded_vertices == len(ball.vertices) - 1
    assert found.degenerate_faces == 0 and found.watertight and found.manifold and found.faces == len(ball.faces) - 2


def test_select_faces_keeps_attributes_and_gradients():
    source = mesh_from(trimesh.creation.icosphere(1))
    v = source.vertices.requires_grad_()
    uv = torch.rand(len(v), 2, generator=torch.Generator().manual_seed(0))
    kept = select_faces(Mesh(v, source.faces, uv=uv), torch.arange(80) < 5)
    assert kept.uv.shape == (len(kept.vertices), 2)
    torch.testing.assert_close(kept.vertices[kept.faces.long()], v[source.faces[:5].long()])
    torch.testing.assert_close(kept.uv[kept.faces.long()], uv[source.faces[:5].long()])
    assert torch.autograd.grad(kept.vertices.sum(), v)[0].sum() == 3 * len(kept.vertices)


@pytest.mark.parametrize(
    "change, error",
    [
        (dict(faces=torch.tensor([[0, 1, -1]], dtype=torch.int32)), ValueError),
        (dict(faces=torch.zeros(3, dtype=torch.int32)), ValueError),
        (dict(normals=torch.zeros(2, 3)), ValueError),
        (dict(uv=torch.zeros(3, 3)), ValueError),
        (dict(tangents=torch.zeros(3, 3)), ValueError),
    ],
)
def test_wrong_input_is_named(change, error):
    arguments = dict(vertices=torch.zeros(3, 3), faces=torch.tensor([[0, 1, 2]], dtype=torch.int32)) | change
    with pytest.raises(error, match=f"^{next(iter(change))}: expected"):
        Mesh(**arguments)


def test_real_meshes_report_the_same_as_trimesh(shared_data):
    files = sorted((shared_data / "meshes").rglob("*.glb"))[:3]
    for file in files:
        source = trimesh.load(file, force="mesh")
        got = report(mesh_from(source))
        merged = trimesh.Trimesh(np.asarray(source.vertices, np.float32), source.faces, process=False)
        merged.merge_vertices(merge_tex=True, merge_norm=True, digits_vertex=12)
        assert got.faces == len(source.faces)
        if got.degenerate_faces == 0:
            assert got.euler == merged.euler_number


def test_normals_of_a_tiny_mesh_are_those_of_a_large_one():
    ball = mesh_from(trimesh.creation.icosphere(3))
    expected = vertex_normals(ball.vertices, ball.faces)
    assert torch.equal(vertex_normals(2.0**-20 * ball.vertices, ball.faces), expected)
    broken = ball.vertices.clone()
    broken[0] = torch.nan
    same = (vertex_normals(broken, ball.faces) == expected).all(1)
    assert int((~same).sum()) <= 7  # the vertex and its neighbors
