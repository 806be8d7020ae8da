"""``reli3d export``: its files, and how it ends."""

import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from reli3d.cli.export import main
from reli3d.fit.transfer import transfer_textures
from reli3d.geometry.bake import bake, rasterize_texels
from reli3d.geometry.mesh import vertex_normals
from reli3d.geometry.uv import unwrap
from reli3d.io.glb import read_glb, write_glb
from reli3d.render.asset import Asset
from reli3d.render.gbuffer import surface_points
from tests.support.meshes import mesh_from
from tests.support.scenes import textures


def colored(shape, size, color) -> Asset:
    """``shape`` with an atlas of ``size`` texels per side, whose base color is a function of the position."""
    mesh = unwrap(mesh_from(shape), texture_size=size).with_tangents()
    base_color = bake(mesh, size, lambda position, normal: color(position))["value"]
    return Asset(mesh, replace(textures(size, "cpu"), base_color=base_color))


def exported(folder: Path, asset: Asset, *options: str) -> Asset:
    """``asset`` stored as a GLB in ``folder``, and exported to another."""
    write_glb(folder / "mesh.glb", asset)
    assert main([str(folder / "mesh.glb"), *options, "--output", str(folder / "out")]) == 0
    return read_glb(folder / "out" / "mesh.glb")[0]


@pytest.fixture(scope="module")
def glb(tmp_path_factory):
    """A ball of 1280 triangles."""
    path = tmp_path_factory.mktemp("export") / "mesh.glb"
    write_glb(path, colored(trimesh.creation.icosphere(3), 128, lambda position: 0.5 + 0.4 * position))
    return path


def test_every_format_is_written_and_named(glb, tmp_path, capsys):
    maps = {f"mesh_{k}.png" for k in ("base_color", "roughness", "metallic", "normal")}
    for kind, expected in (("glb", {"mesh.glb"}), ("usdz", {"mesh.usdz"}), ("obj", {"mesh.obj", "mesh.mtl", *maps})):
        if kind == "usdz":
            pytest.importorskip("pxr", reason="needs usd-core")
        assert main([str(glb), "--format", kind, "--output", str(tmp_path / kind), "--json"]) == 0
        record = json.loads(capsys.readouterr().out)
        assert record["triangles"] == 1280 and record["texture_size"] == 128
        assert {p.name for p in (tmp_path / kind).iterdir()} == expected == {f.split("/")[-1] for f in record["files"]}


def test_fewer_triangles_keep_the_shape_and_the_base_color(glb, tmp_path, capsys):
    pytest.importorskip("fast_simplification")
    assert main([str(glb), "--decimate", "400", "--textures", "webp", "--output", str(tmp_path)]) == 0
    assert capsys.readouterr().out.strip() == str(tmp_path / "mesh.glb")
    (asset,) = read_glb(tmp_path / "mesh.glb")
    assert 300 < len(asset.mesh.faces) <= 400
    # 400 triangles on a unit ball: sagitta of an edge of 0.27 is 0.009
    assert float((asset.mesh.vertices.norm(dim=1) - 1).abs().max()) < 0.03
    uv = (asset.mesh.uv * 128).long().clamp(0, 127)
    base_color = asset.textures.base_color[uv[:, 1], uv[:, 0]]
    # a texel is 0.03 of the ball, where the base color changes by 0.012; borders of charts are a texel off
    assert float((base_color - (0.5 + 0.4 * asset.mesh.vertices)).abs().mean()) < 0.03


def test_vertex_colors_are_baked_where_the_format_has_none_and_notes_are_printed(glb, tmp_path, capsys):
    (asset,) = read_glb(glb)
    colors = 0.5 + 0.5 * asset.mesh.vertices.clamp(-1, 1)
    white = torch.ones_like(asset.textures.base_color)
    asset = replace(asset, mesh=replace(asset.mesh, colors=colors), textures=replace(asset.textures, base_color=white))
    write_glb(tmp_path / "mesh.glb", asset)
    data = (tmp_path / "mesh.glb").read_bytes()
    (tmp_path / "mesh.glb").write_bytes(data.replace(b'"doubleSided":false', b'"alphaMode":"BLEND"'))
    assert main([str(tmp_path / "mesh.glb"), "--format", "obj", "--output", str(tmp_path)]) == 0
    assert "reli3d export: mesh.glb: alpha is left out\n" in capsys.readouterr().err
    shape = trimesh.load(tmp_path / "mesh.obj", process=False, force="mesh")
    image = np.asarray(shape.visual.material.image.convert("RGB")).astype(float) / 255.0
    row, column = ((1 - shape.visual.uv[:, 1]) * 128).astype(int), (shape.visual.uv[:, 0] * 128).astype(int)
    got = torch.from_numpy(image[row.clip(0, 127), column.clip(0, 127)])
    got = torch.where(got <= 0.04045, got / 12.92, ((got + 0.055) / 1.055) ** 2.4)
    expected = 0.5 + 0.5 * torch.from_numpy(np.array(shape.vertices)).clamp(-1, 1)
    assert float((got - expected).abs().mean()) < 0.03  # as above


def test_colors_without_textures_are_baked_at_a_useful_size(tmp_path, capsys):
    mesh = unwrap(mesh_from(trimesh.creation.icosphere(3)), texture_size=64).with_tangents()
    colors = 0.5 + 0.5 * mesh.vertices.clamp(-1, 1)
    write_glb(tmp_path / "mesh.glb", Asset(replace(mesh, colors=colors), textures(4, "cpu", (1.0, 1.0, 1.0))))
    assert main([str(tmp_path / "mesh.glb"), "--format", "obj", "--output", str(tmp_path / "out"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["texture_size"] == 1024


def test_fewer_triangles_keep_the_relief_in_the_normal_map(tmp_path):
    """Waves on a ball with slopes of 17 degrees, finer than the remaining triangles."""
    pytest.importorskip("fast_simplification")
    ball = trimesh.creation.icosphere(6)
    ball.vertices *= 1.0 + 0.005 * np.sin(60.0 * ball.vertices[:, 1:2])
    mesh = unwrap(mesh_from(ball), texture_size=512)
    mesh = replace(mesh, normals=vertex_normals(mesh.vertices, mesh.faces)).with_tangents()
    asset = exported(tmp_path, Asset(mesh, textures(512, "cpu")), "--decimate", "2000")
    face = torch.arange(len(asset.mesh.faces), dtype=torch.int32)
    points = surface_points(asset.mesh, asset.textures, face, torch.full((len(face), 2), 1 / 3))
    y = torch.nn.functional.normalize(points.position, dim=1)[:, 1]
    radius, slope = 1.0 + 0.005 * (60.0 * y).sin(), 0.3 * (60.0 * y).cos() * (1.0 - y * y).sqrt()  # along a meridian
    outward = torch.nn.functional.normalize(points.position, dim=1)
    up = torch.nn.functional.normalize(torch.tensor([0.0, 1.0, 0.0]) - y[:, None] * outward, dim=1)
    expected = torch.nn.functional.normalize(outward - (slope / radius)[:, None] * up, dim=1)
    angle = torch.rad2deg((points.normal * expected).sum(1).clamp(-1, 1).arccos())
    flat = torch.rad2deg((outward * expected).sum(1).clamp(-1, 1).arccos())
    assert float(flat.median()) > 8 and float(angle.median()) < 0.4 * float(flat.median())


def test_smaller_textures_are_averages(tmp_path):
    mesh = unwrap(mesh_from(trimesh.creation.icosphere(2)), texture_size=512).with_tangents()
    gray = torch.rand(512, 512, 1, generator=torch.Generator().manual_seed(0)).expand(-1, -1, 3).contiguous()
    gray[~rasterize_texels(mesh, 512).valid] = 0.0  # unused texels do not bleed into the charts
    asset = exported(tmp_path, Asset(mesh, replace(textures(512, "cpu"), base_color=gray)), "--texture-size", "128")
    center = asset.mesh.uv[asset.mesh.faces.long()].mean(1)
    near = [(center * 128).long() + torch.tensor([a, b]) for a in (-1, 0, 1) for b in (-1, 0, 1)]
    values = torch.cat([asset.textures.base_color[k[:, 1], k[:, 0], 0] for k in near])
    # uniform values have a deviation of 0.29; of 16, bilinear between texels, it is at most 0.07
    assert float(values.std()) < 0.1 and abs(float(values.mean()) - 0.5) < 0.03


def test_textures_are_transferred_within_a_fraction_of_the_size():
    """Two small squares, the upper one black, at 0.1 of the half side: the lower one keeps its color."""
    scale = 0.05
    square = trimesh.Trimesh([[-1, 0, -1], [1, 0, -1], [1, 0, 1], [-1, 0, 1]], [[0, 2, 1], [0, 3, 2]], process=False)
    both = trimesh.util.concatenate([square, square.copy().apply_translation([0, 0.1, 0])]).apply_scale(scale)
    source = colored(both, 64, lambda position: (position[:, 1:2] < 0.05 * scale).float().expand(-1, 3))
    lower = transfer_textures(mesh_from(square.copy().apply_scale(scale)), source, 64)
    uv = ((lower.mesh.uv[lower.mesh.faces.long()].mean(1)) * 64).long()  # centers of the faces
    assert bool((lower.textures.base_color[uv[:, 1], uv[:, 0]] > 0.9).all())


def test_a_missing_extra_is_one_line(glb, tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "pxr", None)
    assert main([str(glb), "--format", "usdz", "--output", str(tmp_path / "out")]) == 2
    message = "reli3d export: --format usdz: usd-core is not installed: pip install 'reli3d[usd]'\n"
    assert capsys.readouterr().err == message
    assert not (tmp_path / "out").exists()
