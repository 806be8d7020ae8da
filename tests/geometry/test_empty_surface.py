"""Fields of one sign: no faces and gradients of zero, a closed box; and mesh operations on no faces."""

import pytest
import torch
import trimesh

from reli3d.cli import infer
from reli3d.geometry import mesh as meshes
from reli3d.geometry.bake import bake, rasterize_texels
from reli3d.geometry.decimate import decimate
from reli3d.geometry.mesh import Mesh, report, vertex_normals
from reli3d.geometry.regularize import sign_entropy, vertex_deviation
from reli3d.geometry.smooth import taubin_smooth
from reli3d.geometry.surface import CubeWeights, extract_surface, surface_cubes
from reli3d.geometry.uv import unwrap, unwrap_xatlas
from reli3d.io.glb import glb_bytes
from reli3d.nn.weights import load, locate, save
from reli3d.render.asset import Asset, TextureSet
from tests.support.meshes import volume
from tests.support.reference_surface import random_weights

SHAPE = (5, 6, 7)
NOTHING = Mesh(torch.zeros(0, 3), torch.zeros(0, 3, dtype=torch.int32))


@pytest.mark.parametrize("center", [False, True])
@pytest.mark.parametrize("value, closed", [(1.0, True), (0.0, True), (-0.0, True), (1.0, False), (-1.0, False)])
def test_a_field_without_a_change_of_sign_has_no_faces_and_gradients_of_zero(device, value, closed, center):
    sdf = torch.full(SHAPE, value, device=device).requires_grad_()
    weights = {k: v.requires_grad_() for k, v in random_weights(SHAPE, 0, device).items()}
    mesh = extract_surface(sdf, radius=1.0, closed=closed, center=center, weights=CubeWeights(**weights))
    assert mesh.vertices.shape == (0, 3) and mesh.faces.shape == (0, 3) and mesh.vertices.device == sdf.device
    assert len(surface_cubes(sdf)) == 0
    leaves = [sdf, *(weights[k] for k in ("deformation", "alpha", "beta"))]
    for g, leaf in zip(torch.autograd.grad(mesh.vertices.sum(), leaves), leaves, strict=True):
        assert g.shape == leaf.shape and float(g.abs().max()) == 0.0
    rows = {k: v.detach() if k == "deformation" else v.detach()[:0] for k, v in weights.items()}
    cubes = torch.zeros(0, dtype=torch.int64, device=device)
    none = CubeWeights(cubes=cubes, **rows)
    assert len(extract_surface(sdf, radius=1.0, closed=closed, center=center, weights=none).faces) == 0
    weights.pop("gamma")
    spread = vertex_deviation(sdf, radius=1.0, closed=closed, weights=CubeWeights(**weights))
    assert spread.shape == (0,)
    assert all(float(g.abs().max()) == 0.0 for g in torch.autograd.grad(spread.sum(), leaves))
    assert float(sign_entropy(sdf.detach())) == 0.0


def test_a_full_field_is_the_box_with_its_edges_cut_off(device):
    """Dual vertices stand at the centers of the border's squares: the convex hull of those is the whole surface."""
    sdf = -torch.ones(SHAPE, device=device)
    mesh = extract_surface(sdf, radius=(1.0, 1.5, 2.0))
    found = report(mesh)
    assert found.watertight and found.manifold and found.euler == 2 and volume(mesh) > 0
    hull = trimesh.Trimesh(mesh.vertices.cpu().numpy()).convex_hull
    assert volume(mesh) == pytest.approx(hull.volume, rel=1e-5)
    assert mesh.vertices.abs().amax(0).tolist() == [1.0, 1.5, 2.0]
    leaf = sdf.requires_grad_()
    for center in (False, True):  # a crossing between a vertex and its copy in the padding does not move
        moved = extract_surface(leaf, radius=1.0, center=center)
        assert float(torch.autograd.grad(moved.vertices.square().sum(), leaf)[0].abs().max()) == 0.0


def test_mesh_operations_accept_no_faces():
    with_all = Mesh(NOTHING.vertices, NOTHING.faces, torch.zeros(0, 3), torch.zeros(0, 2), torch.zeros(0, 4))
    loose = Mesh(torch.rand(4, 3), NOTHING.faces)  # vertices that no face uses
    for mesh in (NOTHING, with_all, loose):
        n = len(mesh.vertices)
        found = report(mesh)
        assert (found.vertices, found.faces, found.components, found.watertight) == (n, 0, 0, False)
        assert not meshes.watertight(mesh) and volume(mesh) == 0.0
        assert vertex_normals(mesh.vertices, mesh.faces).tolist() == [[0.0, 0.0, 1.0]] * n
        assert meshes.face_normals(mesh.vertices, mesh.faces).shape == (0, 3)
        assert len(mesh.with_normals().normals) == n
        assert meshes.face_components(mesh).shape == (0,)
        assert meshes.largest_components(mesh) is mesh
        assert len(meshes.select_faces(mesh, torch.zeros(0, dtype=torch.bool)).vertices) == 0
        assert [len(part) for part in meshes.weld(mesh.vertices)] == [n, n]
        assert torch.equal(taubin_smooth(mesh).vertices, mesh.vertices)
    assert with_all.with_tangents().tangents.shape == (0, 4)
    assert not bool(rasterize_texels(with_all, 8).valid.any())


@pytest.mark.parametrize(
    "call, module",
    [
        (lambda m: decimate(m, 10), "fast_simplification"),
        (lambda m: unwrap(m), "numpy"),
        (lambda m: unwrap_xatlas(m), "xatlas"),
        (lambda m: bake(m, 8, lambda p, n: p), "numpy"),
        (lambda m: glb_bytes(Asset(m, TextureSet(torch.zeros(4, 4, 3), 0.0, 0.0))), "numpy"),
    ],
)
def test_what_needs_a_face_reports_it_in_one_line(call, module):
    pytest.importorskip(module)
    mesh = Mesh(NOTHING.vertices, NOTHING.faces, torch.zeros(0, 3), torch.zeros(0, 2), torch.zeros(0, 4))
    with pytest.raises(ValueError, match=r"^[\w.]*mesh[\w.]*: expected .*, got .*$"):
        call(mesh)


def test_the_command_names_an_empty_field_in_one_line_and_writes_nothing(tmp_path, capsys):
    model, manifest = load(locate("small"))
    with torch.no_grad():
        model.level[-1].bias.fill_(6e4)  # outside everywhere
    save(tmp_path / "blind.safetensors", model, license=manifest.license)
    options = ["--weights", str(tmp_path / "blind.safetensors"), "--texture-size", "256", "--resolution", "24"]
    assert infer.main(["--output", str(tmp_path / "out"), "--device", "cpu", *options]) == 2
    out, err = capsys.readouterr()
    lines = [line for line in err.replace("\r", "\n").split("\n") if line.startswith("reli3d-infer: ")]
    assert out == "" and len(lines) == 1 and lines[0].endswith(": no surface") and "Traceback" not in err
    assert not (tmp_path / "out").exists()
