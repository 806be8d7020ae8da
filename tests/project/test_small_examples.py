"""The examples and the library page's snippets run with nothing but the package, and reach their goal."""

import math
import re
import runpy
import shutil
import sys
from pathlib import Path

import pytest
import torch

import reli3d
from reli3d.io.glb import read_glb
from reli3d.io.images import read_image
from tests.support import reference
from tests.support.checkout import ROOT

EXAMPLES = ROOT / "examples"
PAGE = (ROOT / "docs" / "library.md").read_text()
SNIPPETS = re.findall(r"^```python\n(.*?)^```", PAGE, re.MULTILINE | re.DOTALL)


@pytest.fixture
def run(tmp_path, monkeypatch, capsys):
    """Runs an example with a folder and options; gives the last word of each line that it printed, as a number."""

    def example(name: str, *options: str) -> list[float]:
        monkeypatch.setattr(sys, "argv", [name, str(tmp_path), *options])
        runpy.run_path(str(EXAMPLES / f"{name}.py"))
        return [float(line.split()[-1]) for line in capsys.readouterr().out.splitlines()]

    return example


def test_textures_are_found(run, tmp_path):
    (start,) = run("fit_texture", "--steps", "1", "--size", "48")
    (error,) = run("fit_texture", "--steps", "60", "--size", "48")
    assert error < start / 2  # of 60 steps; 150 at 96 pixels find it better
    found, true = (read_image(tmp_path / f"{name}.png")[0] for name in ("found", "true"))
    assert found.shape == true.shape == (64, 64, 3)


def test_light_is_found(run, tmp_path):
    (start,) = run("fit_light", "--steps", "1", "--size", "24")
    (error,) = run("fit_light", "--steps", "80", "--size", "24")
    assert error < start / 4
    assert (tmp_path / "found.png").is_file()


def test_surface_comes_nearer_than_the_hull(run, tmp_path):
    hull, found = run("fit_shape", "--steps", "25", "--size", "64")
    assert found < hull / 2
    (asset,) = read_glb(tmp_path / "shape.glb")
    assert len(asset.mesh.faces) > 1000


def test_object_and_light_turn(run, tmp_path):
    run("fit_shape", "--steps", "1", "--size", "32")
    run("turntable", "--glb", str(tmp_path / "shape.glb"), "--frames", "3", "--size", "32")
    frames = [read_image(tmp_path / f"{name}_{i:02d}.png") for name in ("turn", "light") for i in range(3)]
    assert all(float(alpha.max()) == 1.0 and torch.isfinite(color).all() for color, alpha in frames)
    assert not torch.equal(frames[3][0], frames[4][0])
    assert (tmp_path / "turntable.webp").stat().st_size > 500


def test_the_snippets_of_the_library_page_are_short_and_correct(tmp_path, monkeypatch):
    scene, *snippets = SNIPPETS[:7]  # the parts of the renderer follow
    assert len(snippets) == 6 and max(len(code.splitlines()) for code in snippets) <= 12
    monkeypatch.chdir(tmp_path)
    found, names = [], {}
    with torch.random.fork_rng():
        torch.manual_seed(0)
        exec(scene, names)
        for code in snippets:
            exec(code, names)
            found.append(dict(names))
    texture, light, rays, normals, pairs, _ = found
    start = (0.5 - 0.6) ** 2  # of the texels, where the loss has seen them
    seen = texture["logits"].detach().abs().amax(-1) > 0.05
    assert int(seen.sum()) > 200
    assert float((texture["logits"].detach().sigmoid()[seen] - 0.6).square().mean()) < 0.5 * start
    above = light["guess"].radiance[:4].mean() - light["guess"].radiance[4:].mean()
    assert float(above) > 0.3  # brighter above, as the true light is
    # closed form: moving all vertices by e along the viewing axis f moves t by e (n . f) / (n . d)
    gradient, hits = rays["vertices"].grad, rays["hits"]
    forward = -rays["camera"].c2w[:3, 2]
    derivative = (2.0 * (rays["depth"].detach() - 2.5) / len(rays["depth"])).double()
    along = rays["directions"][hits.valid].double()
    normal = torch.nn.functional.normalize(face_normals(rays["mesh"], hits), dim=-1)
    expected = (derivative * (normal @ forward.double()) / (normal * along).sum(-1)).sum()
    # float32 sum
    assert float((gradient.double() @ forward.double()).sum()) == pytest.approx(float(expected), rel=1e-3)
    exact = [albedo_by_quadrature(0.25 + step) for step in (0.0, -1e-3, 1e-3)]
    assert normals["albedo"].tolist() == pytest.approx([exact[0]] * 3, abs=0.01)  # 4096 samples of a nearly even weight
    assert float(pairs["derivative"]) == pytest.approx((exact[2] - exact[1]) / 2e-3, abs=0.05)
    color, alpha = read_image(tmp_path / "relit.png")
    assert color.shape == (48, 48, 3) and 0.0 < float(alpha.mean()) < 1.0


def face_normals(mesh, hits):
    corners = mesh.vertices.double()[mesh.faces[hits.face[hits.valid].long()].long()]
    return torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])


def albedo_by_quadrature(alpha: float) -> float:
    """Of a white mirror of GGX width ``alpha`` seen at a cosine of 0.8: a float64 reference summed over the sphere."""
    wi, angle = reference.sphere_grid(600)
    wi = wi.roll(1, -1)  # its pole is y, here z
    wi = wi[wi[:, 2] > 1e-6]
    one = torch.ones(len(wi), dtype=torch.float64)
    wo = torch.tensor([0.6, 0.0, 0.8], dtype=torch.float64).expand(len(wi), 3)
    value = reference.eval_bsdf(wo, wi, one[:, None].expand(-1, 3), alpha * one, one)
    return float((value[:, 0] * wi[:, 2]).sum() * angle)


RECONSTRUCTING = ("reconstruct", "refine", "ReconstructOptions")  # minutes; the README's block runs the same calls


def test_the_examples_of_the_public_names_run(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    shutil.copytree(Path(reli3d.__file__).parent / "assets" / "example", tmp_path / "photos" / "shoe")
    with torch.random.fork_rng():
        torch.manual_seed(0)
        names = {"math": math}
        exec(SNIPPETS[0], names)
        scene, light, normal = names["mesh"], names["light"], torch.nn.functional.normalize(torch.randn(8, 3), dim=-1)
        names |= {"u": torch.rand(8, 2), "alpha": torch.tensor(0.25), "metallic": torch.tensor(0.5)}
        names |= {**dict.fromkeys(("wo", "wi", "wm", "normal", "position"), normal), "color": torch.ones(3)}
        names |= dict(zip(("origins", "directions"), reli3d.camera_rays(names["camera"]), strict=True))
        names |= {"v": scene.vertices.clone().requires_grad_(), "scene": reli3d.RayScene(scene)}
        maps = reli3d.TextureSet(torch.full((64, 64, 3), 0.5), 0.5, 0.0)
        names["asset"] = reli3d.Asset(scene.with_tangents(), maps, light)
        reli3d.write_environment("studio.hdr", light)
        for name in reli3d.__all__[1:]:
            code = "\n".join(re.findall(r"^ *>>> (.*)$", getattr(reli3d, name).__doc__, re.MULTILINE))
            assert len(code.splitlines()) >= 2, name
            compiled = compile(code, name, "exec")
            if name not in RECONSTRUCTING:
                exec(compiled, dict(names))
