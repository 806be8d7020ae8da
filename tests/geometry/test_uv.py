"""The atlas: every face has area, nothing overlaps, charts keep their distance, and any mesh will do."""

import numpy as np
import pytest
import torch
import trimesh

from bench.surface import field
from reli3d.geometry import charts, uv
from reli3d.geometry.bake import nearest_valid
from reli3d.geometry.mesh import Mesh
from reli3d.geometry.surface import extract_surface
from reli3d.geometry.topology import face_neighbors
from reli3d.geometry.uv import guard_band, source_vertices, unwrap, unwrap_xatlas
from tests.support.meshes import QUICK, SLOW, coverage, loaded, mesh_from, mesh_of

slow = pytest.mark.slow


def icosphere(subdivisions: int) -> Mesh:
    return mesh_from(trimesh.creation.icosphere(subdivisions))


def ramp(turns: int, steps: int = 12) -> Mesh:
    """Helical ramp around a hole, every turn exactly above the last: in projection all sheets and edges coincide."""
    angle = np.arange(turns * steps + 1) * (2 * np.pi / steps)
    rim = [np.stack([r * np.cos(angle), 0.1 * angle, r * np.sin(angle)], 1) for r in (1.0, 2.0)]
    k = np.arange(turns * steps)
    n = len(angle)
    faces = np.concatenate([np.stack([k, k + 1, n + k], 1), np.stack([k + 1, n + k + 1, n + k], 1)])
    return mesh_of(np.concatenate(rim), faces)


def test_cuts_are_judged_by_the_boxes_of_their_pieces():
    """Against numpy in float64, which sums in another order; also charts of one point and of two equal ones."""
    generator = np.random.default_rng(0)
    sizes = [1, 2, 7, 400, 33]
    points = [generator.normal(size=(n, 2)) * generator.uniform(0.1, 30.0, 2) for n in sizes]
    points[1][1] = points[1][0]
    angle = np.arange(charts.CUT_ANGLES) * (np.pi / charts.CUT_ANGLES)
    axes = np.stack([np.cos(angle), np.sin(angle)])
    at, area = charts.cuts(np.concatenate(points) @ axes, np.cumsum([0, *sizes]).astype(np.int32))

    def box(piece: np.ndarray) -> float:
        extent = np.ptp(piece @ axes, axis=0) if len(piece) else np.zeros(8)
        return min(extent[k] * extent[(k + 4) % 8] for k in range(8))

    for c, chart in enumerate(points):
        for k in range(8):
            along = chart @ axes[:, k]
            for kind, place in enumerate([(along.max() + along.min()) / 2, along.mean()]):
                np.testing.assert_allclose(at[c, k, kind], place, rtol=1e-12, atol=1e-12)
                upper = along > at[c, k, kind]
                np.testing.assert_allclose(area[c, k, kind], box(chart[upper]) + box(chart[~upper]), rtol=1e-12)


def areas(mesh: Mesh) -> np.ndarray:
    """Signed area in (u, 1 - v), float64, of the faces as stored in float32."""
    q = mesh.uv.numpy()[mesh.faces.numpy()].astype(np.float64)
    d1, d2 = q[:, 1] - q[:, 0], q[:, 2] - q[:, 0]
    return -0.5 * (d1[:, 0] * d2[:, 1] - d1[:, 1] * d2[:, 0])


def chart_count(mesh: Mesh) -> int:
    """Charts, connected through equal UV."""
    labels = np.unique(mesh.uv.numpy(), axis=0, return_inverse=True)[1].reshape(-1)[mesh.faces.numpy()]
    return charts.components(face_neighbors(labels), np.zeros(len(labels), np.int32))[1]


def utilization(mesh: Mesh) -> float:
    """Fraction of the UV square that faces cover."""
    return float((coverage(mesh, 2048) > 0).float().mean())


def stretches(mesh: Mesh) -> tuple[float, float]:
    """L2 stretch of Sander et al. 2001 and the largest length on the surface per UV length, over the mean scale."""
    p, q = (v.double()[mesh.faces.long()] for v in (mesh.vertices, mesh.uv))
    edges, moves = (torch.stack([v[:, 1] - v[:, 0], v[:, 2] - v[:, 0]], -1) for v in (p, q))
    lengths = torch.linalg.svdvals(edges @ torch.linalg.inv(moves))
    area = torch.linalg.cross(edges[..., 0], edges[..., 1]).norm(dim=-1) / 2
    mean = (area.sum() / (torch.linalg.det(moves).abs().sum() / 2)).sqrt()
    return float(((area @ lengths.square().mean(-1)) / area.sum()).sqrt() / mean), float(lengths.max() / mean)


def check_atlas(source: Mesh, result: Mesh, size: int = 2048, rel: float = 3e-3) -> None:
    area = areas(result)
    assert (area > 0).all()
    assert float(result.uv.min()) >= 0.0 and float(result.uv.max()) <= 1.0
    assert torch.equal(result.vertices[result.faces.long()], source.vertices[source.faces.long()])
    hits = coverage(result, size)
    covered = int((hits > 0).sum())
    assert int((hits > 1).sum()) <= 1e-3 * covered
    # overlap would make the areas add up to more than is covered; thousands of tiny charts are counted up to 1 % high
    assert area.sum() <= (1 + rel) * covered / size**2
    assert area.sum() >= (1 - 5 * rel) * covered / size**2


@pytest.mark.parametrize("name", QUICK + [pytest.param(n, marks=slow) for n in SLOW])
def test_real_meshes_have_area_everywhere_and_no_overlap(shared_data, name):
    mesh = loaded(shared_data / "meshes" / f"{name}.glb")
    check_atlas(mesh, unwrap(mesh, texture_size=1024))


def test_sphere_fills_the_atlas_with_little_stretch():
    mesh = icosphere(5)
    result = unwrap(mesh, texture_size=1024)
    check_atlas(mesh, result)
    assert chart_count(result) == 6 and utilization(result) > 0.55
    # a cap of 54.7 degrees seen along its axis: stretch at the tip 1 / cos = 1.73, less the common scale
    mean, largest = stretches(result)
    assert mean < 1.05 and largest < 1.74


@pytest.mark.parametrize("n", [32, pytest.param(80, marks=slow), pytest.param(160, marks=slow)])
def test_extracted_surfaces_up_to_a_hundred_thousand_faces(n):
    mesh = extract_surface(field(n, "cpu"), radius=0.87)
    assert n < 160 or len(mesh.faces) > 100_000
    check_atlas(mesh, unwrap(mesh, texture_size=1024))


def test_a_long_part_does_not_hold_down_the_scale():
    mesh = mesh_from(trimesh.creation.box((30.0, 1.0, 1.0)).subdivide().subdivide().subdivide())
    result = unwrap(mesh, texture_size=512)
    check_atlas(mesh, result)
    # 122 units of area; uncut, the longest chart's 30 units would span the side and use 122 / 900 of it
    assert utilization(result) > 0.5


@pytest.mark.parametrize("size", [256, 512])
def test_charts_keep_the_guard_band(size):
    result = unwrap(icosphere(3), texture_size=size)
    neighbors = face_neighbors(result.faces.numpy())
    chart, count = charts.components(neighbors, np.zeros(len(neighbors), np.int32))
    fine = 2  # samples along a texel
    for c in range(count):
        own, others = (
            Mesh(result.vertices, result.faces[torch.from_numpy(m)].contiguous(), uv=result.uv)
            for m in (chart == c, chart != c)
        )
        _, square = nearest_valid(coverage(own, size * fine) > 0)
        gap = float(square[coverage(others, size * fine) > 0].min()) ** 0.5 / fine
        assert gap >= guard_band(size) - 2.0 / fine  # sample centers lie up to a sample inside on both sides
        corner = result.uv[own.faces.long()]
        assert float(torch.minimum(corner, 1 - corner).min()) * size >= 0.5 * guard_band(size) - 1e-3  # float32 uv


def test_stacked_sheets_are_distinguished():
    mesh = ramp(5)
    result = unwrap(mesh, texture_size=512)
    check_atlas(mesh, result)
    assert chart_count(result) <= 10  # five turns: each one chart, or cut once


def test_a_slab_folded_over_itself_is_distinguished():
    # a flat S: every face points up, the sheets overlap and cross in projection
    t = np.linspace(0, 1, 60)
    path = np.stack([np.cos(4 * np.pi * t) * (1 + t), 0.5 * t, np.sin(4 * np.pi * t) * (1 + t)], 1)
    side = path * [1.5, 1.0, 1.5]
    k, n = np.arange(59), 60
    mesh = mesh_of(
        np.concatenate([path, side]),
        np.concatenate([np.stack([k, k + 1, n + k], 1), np.stack([k + 1, n + k + 1, n + k], 1)]),
    )
    check_atlas(mesh, unwrap(mesh, texture_size=512))


def test_degenerate_non_manifold_and_repeated_faces(device):
    vertices = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [0, -1, 0], [0.5, 0, 0], [5, 5, 5]]
    faces = [[0, 1, 2], [0, 1, 3], [0, 1, 4], [0, 1, 2], [0, 2, 1]]  # five at one edge, one twice, one turned
    faces += [[0, 5, 1], [3, 3, 1], [2, 2, 2]]  # in line, two corners, one corner; vertex 6 unused
    mesh = mesh_of(vertices, faces)
    check_atlas(mesh, unwrap(mesh, texture_size=256), size=1024)


@pytest.mark.parametrize("faces", [[[0, 1, 2]], [[0, 0, 0]], [[0, 0, 0]] * 300])
def test_a_single_triangle_and_nothing_but_points(faces):
    mesh = mesh_of([[0, 0, 0], [1e-3, 0, 0], [0, 1e-3, 0]], faces)
    result = unwrap(mesh, texture_size=64)
    assert (areas(result) > 0).all()
    assert int((coverage(result, 512) > 1).sum()) == 0


@pytest.mark.parametrize("scale, offset", [(1e-5, 0.0), (1e6, 0.0), (1.0, 100.0)])
def test_size_and_place_of_the_mesh_do_not_matter(scale, offset):
    mesh = icosphere(3)
    moved = Mesh((mesh.vertices + offset) * scale, mesh.faces)
    check_atlas(moved, unwrap(moved, texture_size=256), size=1024)


def test_a_soup_of_triangles_fits():
    rng = np.random.default_rng(0)
    center = rng.uniform(-1, 1, (3000, 1, 3))
    corners = center + rng.normal(0, 0.05, (3000, 3, 3))
    mesh = mesh_of(corners.reshape(-1, 3), np.arange(9000).reshape(-1, 3))
    check_atlas(mesh, unwrap(mesh, texture_size=512), rel=2e-2)  # all border: 3,000 triangles of about 150 samples


def test_normals_are_taken_over_and_gradients_reach_the_vertices():
    mesh = icosphere(2)
    vertices = mesh.vertices.clone().requires_grad_()
    result = unwrap(Mesh(vertices, mesh.faces), texture_size=128)
    # a unit sphere's area-weighted normals point along its vertices: exact up to the subdivision's unevenness
    assert float((result.normals * result.vertices).detach().sum(1).min()) > 0.998
    result.vertices.sum().backward()
    split = torch.bincount(torch.cdist(result.vertices.detach(), mesh.vertices).argmin(1), minlength=len(mesh.vertices))
    torch.testing.assert_close(vertices.grad, split[:, None].float().expand(-1, 3))
    assert not result.uv.requires_grad


@pytest.mark.parametrize("atlas", [unwrap, unwrap_xatlas])
def test_split_vertices_refer_to_their_originals(atlas):
    whole = icosphere(2)
    mesh = atlas(whole)
    assert len(mesh.vertices) > len(whole.vertices)
    assert torch.equal(whole.vertices[source_vertices(whole, mesh).long()], mesh.vertices)
    with pytest.raises(ValueError, match=r"mesh.faces: expected 1 faces, got 320"):
        source_vertices(Mesh(whole.vertices, whole.faces[:1]), mesh)


def test_neighbors_skip_borders_and_crowded_edges():
    faces = np.array([[0, 1, 2], [2, 1, 3], [4, 5, 6], [5, 4, 7], [4, 5, 8]])
    assert face_neighbors(faces).tolist() == [[-1, 1, -1], [0, -1, -1], [-1] * 3, [-1] * 3, [-1] * 3]


def test_faults_are_named():
    mesh = icosphere(0)
    with pytest.raises(ValueError, match="finite coordinates"):
        unwrap(Mesh(mesh.vertices * float("nan"), mesh.faces))
    with pytest.raises(ValueError, match="texture_size: expected an integer"):
        unwrap(mesh, texture_size=4)
    with pytest.raises(TypeError, match="mesh: expected Mesh"):
        unwrap(mesh.vertices)


def test_xatlas_gives_an_atlas_or_a_named_end():
    mesh = icosphere(2)
    result = unwrap_xatlas(mesh, texture_size=256)
    hits = coverage(result, 1024)
    assert (np.abs(areas(result)) > 0).all() and int((hits > 1).sum()) <= 1e-3 * int((hits > 0).sum())
    assert torch.equal(result.vertices[result.faces.long()], mesh.vertices[mesh.faces.long()])
    with pytest.raises(TimeoutError, match="no atlas of 320 faces in 0.01 s"):
        unwrap_xatlas(mesh, timeout_s=0.01)


def test_guard_band_grows_with_the_texture():
    assert [uv.guard_band(s) for s in (128, 256, 512, 1024, 2048, 4096)] == [2, 2, 4, 4, 8, 16]


@pytest.mark.parametrize("radius, center", [(0.7e-3, 0.0), (1e-9, 0.0), (1e12, 0.0), (0.7e-3, 0.5)])
def test_xatlas_takes_meshes_of_any_size(radius, center):
    ball = trimesh.creation.icosphere(3)
    result = unwrap_xatlas(mesh_of(ball.vertices * radius + center, ball.faces), texture_size=256)
    assert bool(torch.isfinite(result.uv).all())
    hits = coverage(result, 1024)
    assert int((hits > 0).sum()) > 0.4 * 1024**2 and int((hits > 1).sum()) < 0.01 * int((hits > 0).sum())


def test_an_atlas_of_xatlas_with_nan_is_refused(monkeypatch):
    monkeypatch.setattr(uv, "XATLAS", uv.XATLAS.replace("uv=uv", "uv=uv * numpy.nan"))
    with pytest.raises(RuntimeError, match="unwrap_xatlas: expected finite texture coordinates"):
        unwrap_xatlas(icosphere(1), texture_size=64)


def test_more_charts_than_texels_are_refused():
    corners = torch.rand(300, 3, 3, generator=torch.Generator().manual_seed(0))
    with pytest.raises(ValueError, match="texture_size: expected more texels for the 300 charts"):
        unwrap(mesh_of(corners.reshape(-1, 3).numpy(), np.arange(900).reshape(-1, 3)), texture_size=16)


def test_a_closed_part_without_area_is_unwrapped_with_the_rest():
    box = trimesh.creation.box()
    points = np.concatenate([box.vertices, [[2.0, 0, 0], [2.5, 0, 0], [3.0, 0, 0]]])
    mesh = unwrap(mesh_of(points, np.concatenate([box.faces, [[8, 9, 10], [10, 9, 8]]])), texture_size=128)
    assert bool(torch.isfinite(mesh.uv).all()) and len(mesh.faces) == 14
    assert (np.abs(areas(mesh))[:12] > 0).all()
