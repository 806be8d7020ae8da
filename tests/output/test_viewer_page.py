"""``viewer.html`` in headless Chromium, opened as a file: its images against those of our renderer."""

import base64
import io
import json
import math
import re
import zlib
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from reli3d.cli import infer
from reli3d.geometry.camera import Camera, look_at
from reli3d.geometry.mesh import Mesh, vertex_normals
from reli3d.io.glb import glb_bytes, read_glb, write_glb
from reli3d.io.hdr import read_environment
from reli3d.output import viewer
from reli3d.output.viewer import Shown, photograph_stops, shadow, viewer_page
from reli3d.render.asset import Asset, TextureSet
from reli3d.render.color import linear_to_srgb
from reli3d.render.environment import Environment
from reli3d.render.image import Render, render_asset
from reli3d.render.lights import sky, studio
from reli3d.render.transfer import spherical_harmonics
from reli3d.views.views import Views
from tests.support.browser import chromium, pixels, show
from tests.support.example import QUICK
from tests.support.scenes import ball_mesh, textures

SIZE, WIDE = 192, 336  # the page's window is wider than the photographs
READY = "document.body.dataset.ready"
EYES = ((0.9, 0.6, 2.0), (-2.0, 0.5, -0.6))
# Minimum PSNR of each lighting.  On a ball, which has no self-occlusion, the limit is three.js' light prefiltered by
# roughness, whose lobes are narrower than GGX: a ball half of rough metal reaches 24.9.
DECIBELS = 26.0


@pytest.fixture(scope="module")
def tab():
    with chromium() as tab:
        yield tab


@pytest.fixture(scope="module")
def asset(tmp_path_factory) -> Asset:
    """A ball: convex, textured, with a metal edge, rough enough for prefiltered light."""
    mesh = ball_mesh(4, 0.7)
    rows, columns = torch.meshgrid(torch.arange(64), torch.arange(64), indexing="ij")
    color = torch.stack([0.3 + rows / 128, 0.9 - columns / 96, (0.4 + (rows + columns) / 256)], -1)
    metal = (columns >= 52).float()
    maps = TextureSet(color, 0.35 + 0.2 * metal, metal)
    return stored(tmp_path_factory.mktemp("page"), Asset(mesh, maps))


def stored(folder: Path, asset: Asset) -> Asset:
    """``asset`` as the page has it, rounded to 8 bits, in the light of the studio."""
    write_glb(folder / "mesh.glb", asset)
    (part,) = read_glb(folder / "mesh.glb")
    return Asset(part.mesh, part.textures, studio())


@pytest.fixture(scope="module")
def waisted(tmp_path_factory) -> Asset:
    """A gray body with a deep groove about it, in which little of the light arrives."""
    ball = ball_mesh(5, 1.0)
    away = torch.linalg.cross(ball.vertices, torch.tensor([0.36, 0.8, 0.48]).expand_as(ball.vertices)).square().sum(-1)
    vertices = ball.vertices * (0.7 - 0.45 * torch.exp(-12.0 * (1.0 - away)))[:, None]
    mesh = Mesh(vertices, ball.faces, vertex_normals(vertices, ball.faces), ball.uv).with_tangents()
    return stored(tmp_path_factory.mktemp("waisted"), Asset(mesh, textures(4, "cpu", (0.32, 0.32, 0.32), 0.5)))


@pytest.fixture(scope="module")
def views() -> Views:
    """Two blue photographs of the ball's cameras, whose principal point is off the middle."""
    up, zero = torch.tensor([0.0, 1.0, 0.0]), torch.zeros(3)
    c2w = torch.stack([look_at(torch.tensor(eye), zero, up) for eye in EYES])
    image, mask = torch.tensor([0.0, 0.0, 1.0]).expand(SIZE, SIZE, 3).contiguous(), torch.ones(SIZE, SIZE)
    intrinsics = torch.tensor([[225.0, 217.5, 105.0, 90.0]] * 2)
    return Views((image,) * 2, (mask,) * 2, c2w, intrinsics, ("front </script>.png", "back.png"))


def ours(asset: Asset, views: Views, i: int, light: Environment, **options) -> Render:
    """The view of the page's window: the photograph's, with more at its sides."""
    camera = views.intrinsics[i] + torch.tensor([0.0, 0.0, (WIDE - SIZE) / 2, 0.0])
    return render_asset(asset, Camera(views.c2w[i], camera, WIDE, SIZE), light, supersampling=2, **options)


def psnr(image: np.ndarray, color: torch.Tensor, alpha: torch.Tensor, *, shared: float = 0.99) -> float:
    """Decibels on the pixels of both masks; also checks that more than ``shared`` of their pixels coincide."""
    mask = image[..., 3] > 127
    assert (mask & (alpha.numpy() > 0.5)).sum() / (mask | (alpha.numpy() > 0.5)).sum() > shared
    both = (image[..., 3] == 255) & (alpha.numpy() > 0.999)
    error = (image[..., :3][both] / 255.0 - color.numpy()[both]).astype(np.float64)
    return float(-10 * np.log10(np.mean(error**2)))


def shown(image: Render, brightness: float = 1.0) -> torch.Tensor:
    unmultiplied = brightness * image.radiance / image.alpha[..., None].clamp(min=1e-6)
    return linear_to_srgb(unmultiplied.clamp(0, 1))


def choose(**values) -> str:
    """JavaScript that sets the page's controls and fires their events."""
    code = ""
    for name, value in values.items():
        field = "checked" if isinstance(value, bool) else "value"
        code += f"get('{name}').{field} = {json.dumps(value)}; get('{name}').dispatchEvent(new Event('input')); "
    return code


def one_page(asset: Asset, views: Views, light: Environment | None = None, meshes=("mesh",)) -> str:
    shown = Shown(glb_bytes(asset), shadow(asset.mesh))
    radiance = (light or asset.light).radiance
    stops = photograph_stops(views)
    return viewer_page("a <ball>", dict.fromkeys(meshes, shown), radiance, torch.zeros(3), 0.7, stops)


def test_the_page_shows_the_asset_as_the_renderer_does(tmp_path, tab, asset, views):
    (tmp_path / "viewer.html").write_text(one_page(asset, views, meshes=("before", "after")))
    show(tab, (tmp_path / "viewer.html").as_uri(), size=(WIDE, SIZE), ready=READY)

    def rendered(**values) -> np.ndarray:
        return pixels(tab.evaluate(choose(**values) + "imageURL()"))

    tab.evaluate("take(0)")
    first = ours(asset, views, 0, asset.environment)
    own = psnr(rendered(), shown(first), first.alpha)
    layers = {
        "base color": linear_to_srgb(first.base_color / first.alpha[..., None].clamp(min=1e-6)),
        "roughness": (first.roughness / first.alpha.clamp(min=1e-6))[..., None].expand(-1, -1, 3),
        "metallic": (first.metallic / first.alpha.clamp(min=1e-6))[..., None].expand(-1, -1, 3),
        "normal": torch.nn.functional.normalize(first.normal, dim=-1) / 2 + 0.5,
    }
    found = {name: psnr(rendered(layer=name), color, first.alpha) for name, color in layers.items()}
    wires = rendered(layer="wireframe")
    tab.evaluate("take(1)")
    turned = ours(asset, views, 1, Environment(sky().radiance).rotated(math.pi / 2))
    relit = psnr(rendered(layer="lit", light="sky", turn=90, stopsof=-1), shown(turned, 0.5), turned.alpha)
    still = psnr(rendered(turn=0), shown(turned, 0.5), turned.alpha)
    behind = rendered(behind=True)
    tab.evaluate(choose(blend=1.0))
    covered = np.asarray(Image.open(io.BytesIO(tab.screenshot())).convert("RGB"))
    tab.evaluate("leave()")
    free = tab.evaluate("photograph.hidden")
    title, choices = tab.evaluate("document.title"), tab.evaluate("get('mesh').parentElement.hidden")
    assert tab.problems == []
    assert own > DECIBELS, own
    assert relit > DECIBELS, relit
    assert still < relit - 6, (still, relit)  # turning does turn
    assert min(found.values()) > 40, found  # 8 bits: 58; the metal's border, filtered otherwise: 52
    assert 0.02 < (wires[..., 3] > 127).mean() < 0.9
    assert (behind[..., 3] == 255).all()
    right = covered[:, -(WIDE - SIZE) // 2 - 30 : -(WIDE - SIZE) // 2 - 2]  # the panel is at the left
    assert np.abs(right.astype(int) - (0, 0, 255)).max() < 12  # the photograph, by lossy WebP
    assert free and not choices and title == "a <ball>"


def test_the_page_shows_self_occlusion(tmp_path, tab, waisted, views):
    """In each light, turned and brightened: nearer to our renderer than without, and near."""
    (tmp_path / "viewer.html").write_text(one_page(waisted, views, studio()))
    found = {}
    show(tab, (tmp_path / "viewer.html").as_uri(), size=(WIDE, SIZE), ready=READY)
    for i, (name, turn, stops, light) in enumerate((("estimated light", 30, 0, studio()), ("sky", -60, -1, sky()))):
        code = f"take({i}); " + choose(light=name, turn=turn, stopsof=stops) + "imageURL()"
        rendering, turned = pixels(tab.evaluate(code)), light.rotated(math.radians(turn))
        for shadows in (True, False):
            image = ours(waisted, views, i, turned, shadows=shadows)
            found[name, shadows] = psnr(rendering, shown(image, 2.0**stops), image.alpha)
    assert tab.problems == []
    for name in ("estimated light", "sky"):
        assert found[name, True] > DECIBELS and found[name, True] > found[name, False] + 2, found


def test_the_harmonics_of_the_page_are_ours():
    """Its shader's lines are arithmetic that Python reads as well."""
    source = (viewer.PARTS / "viewer.js").read_text()
    d = torch.nn.functional.normalize(torch.randn(50, 3, generator=torch.Generator().manual_seed(0)).double(), dim=-1)
    x, y, z = d[:, 2], d[:, 0], d[:, 1]
    assert "float x = d.z, y = d.x, z = d.y, xx = x * x, yy = y * y, zz = z * z;" in source
    (text,) = re.findall(r"return mat4[(](0[.]28.*?)[)];", source, re.DOTALL)
    values = eval(f"[{text}]", {}, {"x": x, "y": y, "z": z, "xx": x * x, "yy": y * y, "zz": z * z})
    got = torch.stack([value * torch.ones_like(x) for value in values], -1)
    torch.testing.assert_close(got, spherical_harmonics(d), rtol=0, atol=2e-7)  # seven digits


def test_a_half_hidden_everywhere_is_a_stop_less(tmp_path, tab, asset, views, monkeypatch):
    """Half of an open surface's transfer as occlusion; other harmonics would leave a remainder."""
    cosine = torch.tensor([math.pi] + [2 * math.pi / 3] * 3 + [math.pi / 4] * 5 + [0.0] * 7)  # of the harmonics
    images = []
    for hidden, stops in ((0.5, 0), (0.0, -1)):
        monkeypatch.setattr(
            viewer, "blocked_transfer", lambda m, scene, h=hidden: h * cosine * spherical_harmonics(m.normals)
        )
        (tmp_path / f"{stops}.html").write_text(one_page(asset, views, sky()))
        show(tab, (tmp_path / f"{stops}.html").as_uri(), size=(WIDE, SIZE), ready=READY)
        images.append(pixels(tab.evaluate("take(0); " + choose(turn=40, stopsof=stops) + "imageURL()")).astype(int))
    assert tab.problems == []
    assert np.abs(images[0] - images[1]).max() <= 4  # of 255: coefficients have 8 bits


def test_the_page_of_the_example_looks_as_its_image_by_the_renderer(tmp_path, tab):
    """The estimated light from the first photograph."""
    assert infer.main(["--output", str(tmp_path), *QUICK]) == 0
    (part,) = read_glb(tmp_path / "example" / "mesh.glb")
    light = read_environment(tmp_path / "example" / "environment.exr")
    show(tab, (tmp_path / "example" / "viewer.html").as_uri(), size=(SIZE, SIZE), ready=READY)
    (view, *_) = tab.evaluate("data.views")
    rendering = pixels(tab.evaluate("take(0); imageURL()"))
    assert tab.problems == []
    camera = torch.tensor(view["intrinsics"]) * (SIZE / view["width"])
    image = render_asset(part, Camera(torch.tensor(view["c2w"]), camera, SIZE, SIZE), light, supersampling=2)
    assert psnr(rendering, shown(image), image.alpha, shared=0.98) > 30.0  # its handle is thin


def test_the_page_of_a_reconstruction_holds_all_it_needs(asset, views):
    page = one_page(asset, views)
    assert not re.search(r"""(src|href)=["']?(https?:)?//""", page)
    assert page.count("</script>") == 3  # a name cannot end the data
    data = json.loads(re.search(r'id="data">(.*?)</script>', page, re.DOTALL)[1])
    assert len(zlib.decompress(base64.b64decode(data["meshes"][0]["blocked"]))) == 16 * len(asset.mesh.vertices)
    assert [light["name"] for light in data["lights"]] == ["estimated light", "studio", "sky"]
    assert [view["name"] for view in data["views"]] == list(views.names)


def test_large_photographs_are_scaled_with_their_cameras():
    intrinsics = torch.tensor([[3000.0, 2900.0, 990.0, 510.0]])
    views = Views((torch.rand(1000, 2000, 3),), (torch.ones(1000, 2000),), torch.eye(4)[None], intrinsics, ("a",))
    (view,) = photograph_stops(views)
    assert (view["width"], view["height"]) == (640, 320)
    np.testing.assert_allclose(view["intrinsics"], [960.0, 928.0, 316.8, 163.2])
