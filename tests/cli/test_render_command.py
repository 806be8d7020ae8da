"""``reli3d-render``: its files against :func:`reli3d.render.image.render_asset` of the same view, and how it ends."""

import contextlib
import io
import json
import math
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from reli3d.cli.render import main
from reli3d.geometry.camera import Camera, camera_rays
from reli3d.io.glb import read_glb, write_glb
from reli3d.io.hdr import read_environment, read_hdr_image, write_environment
from reli3d.render.asset import Asset
from reli3d.render.color import agx, linear_to_srgb
from reli3d.render.environment import Environment
from reli3d.render.image import render_asset
from reli3d.render.shading import ShadeOptions
from tests.support.rigs import rig
from tests.support.scenes import ball_mesh, textures

SIZE, DISTANCE = 24, 2.6


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """Folder with a red ball and, as .hdr and .exr, a light whose one half is dark; exact in either format."""
    folder = tmp_path_factory.mktemp("render")
    write_glb(folder / "ball.glb", Asset(ball_mesh(3, 0.6), textures(4, "cpu", (0.79, 0.01, 0.01))))
    light = torch.full((8, 16, 3), 0.0625)
    light[:, :8] = torch.tensor([2.0, 1.0, 1.0])
    light = light.roll(-4, 1)  # the borders of the halves look to -Z and +Z
    write_environment(folder / "half.hdr", Environment(light))
    write_environment(folder / "half.exr", Environment(light))
    return folder


def run(folder, *options, light="half.hdr"):
    """Files that the command names on stdout, by name."""
    out = folder / "out"
    common = ["--output", str(out), "--size", str(SIZE), "--distance", str(DISTANCE), "--supersampling", "1"]
    lit = [] if light is None else ["--light", str(folder / light)]
    output = io.StringIO()
    with contextlib.redirect_stdout(output):
        assert main([str(folder / "ball.glb"), *common, *lit, *options]) == 0
    return {Path(name).name: Path(name) for name in output.getvalue().splitlines()}


def expected(folder, *, azimuth=30.0, yaw=0.0, seed=0, **options):
    """The expected view: the eye is ``azimuth`` degrees from +Z towards +X and 20 above the horizon."""
    parts = read_glb(folder / "ball.glb")
    low, high = parts[0].mesh.vertices.amin(0), parts[0].mesh.vertices.amax(0)
    pose = rig((azimuth, 20.0, DISTANCE), target=((low + high) / 2).tolist())[0]
    camera = Camera.from_fov(pose, math.radians(32.0), SIZE, SIZE)
    light = read_environment(folder / "half.hdr").rotated(yaw)
    return render_asset(parts, camera, light, options=ShadeOptions(seed=seed), **options), camera, light


def pixels(path):
    return torch.from_numpy(np.asarray(Image.open(path)).copy())


def bytes_of(display):
    return (display.clamp(0.0, 1.0) * 255.0 + 0.5).to(torch.uint8)


def same_image(got, expected):
    """8 bits; a value next to a rounding step may fall on its other side."""
    off = (got.int() - expected.int()).abs()
    return got.shape == expected.shape and int(off.max()) <= 1 and float((off > 0).float().mean()) < 0.01


def unpremultiplied(image):
    """Color before its premultiplication by alpha; the transforms to 8 bits take this."""
    return image.radiance / image.alpha[..., None].clamp(min=1e-6)


def test_linear_files_and_layers_are_those_of_render(scene):
    image = expected(scene)[0]
    for light in ("half.hdr", "half.exr"):  # the same radiance by either file
        files = run(scene, "--format", "exr", "--aovs", light=light)
        assert set(files) == {"ball.exr", *(f"ball_{k}.exr" for k in ("base_color", "material", "normal", "depth"))}
        radiance = read_hdr_image(files["ball.exr"])
        torch.testing.assert_close(radiance, image.radiance, rtol=2**-10, atol=1e-6)  # half floats
    zero, seen = torch.zeros_like(image.alpha), image.alpha > 0.0
    assert 0.2 < float(seen.float().mean()) < 0.8 and float(image.radiance.max()) > 0.1
    depth = torch.where(seen, image.depth, 0.0)
    layers = {
        "base_color": image.base_color,
        "material": torch.stack([zero, image.roughness, image.metallic], -1),
        "normal": torch.where(seen[..., None], image.normal / 2 + 0.5, 0.0),
        "depth": torch.stack([depth, depth, image.alpha], -1),
    }
    for name, layer in layers.items():
        torch.testing.assert_close(read_hdr_image(files[f"ball_{name}.exr"]), layer, rtol=0, atol=1e-6)
    brighter = read_hdr_image(run(scene, "--format", "exr", "--exposure", "1")["ball.exr"])
    torch.testing.assert_close(brighter, 2.0 * radiance, rtol=2**-10, atol=0)
    clear = read_hdr_image(run(scene, "--format", "exr", "--no-shadows", "--seed", "5")["ball.exr"])
    unshadowed = expected(scene, seed=5, shadows=False)[0].radiance
    torch.testing.assert_close(clear, unshadowed, rtol=2**-10, atol=1e-6)


@pytest.mark.parametrize("tone, transform", [("srgb", linear_to_srgb), ("agx", agx), ("none", lambda v: v)])
def test_images_are_the_display_transform_of_the_exposed_radiance(scene, tone, transform):
    image = expected(scene)[0]
    for stops in (0, 1):
        rendering = pixels(run(scene, "--tone", tone, "--exposure", str(stops))["ball.png"])
        shown = torch.cat([transform(2.0**stops * unpremultiplied(image)), image.alpha[..., None]], -1)
        assert same_image(rendering, bytes_of(shown))
    assert int(rendering[SIZE // 2, SIZE // 2, 0]) > int(rendering[SIZE // 2, SIZE // 2, 1])  # the red ball


def test_environment_is_the_background_if_requested(scene):
    image, camera, light = expected(scene, azimuth=5.0, background="environment")  # the center of the map is in view
    rendering = pixels(run(scene, "--background", "environment", "--azimuth", "5")["ball.png"])
    assert same_image(rendering, bytes_of(linear_to_srgb(image.radiance)))
    behind = bytes_of(linear_to_srgb(light.lookup(camera_rays(camera)[1])))
    free = image.alpha == 0.0
    assert same_image(rendering[free], behind[free])
    assert int(behind[free].int().amax()) - int(behind[free].int().amin()) > 100  # both halves of the light


@pytest.mark.parametrize("turn", ["camera", "light"])
def test_turntables_are_their_frames(scene, turn, monkeypatch):
    """As numbered PNG and EXR files and as one animation; the progress goes to the error stream of a terminal."""
    frames = []
    for k in range(3):
        view = {"azimuth": 30.0 + 120.0 * k} if turn == "camera" else {"yaw": 2.0 * math.pi * k / 3}
        frames.append(expected(scene, seed=k, **view)[0])
    terminal = io.StringIO()
    terminal.isatty = lambda: True
    monkeypatch.setattr(sys, "stderr", terminal)
    options = ["--frames", "3", "--turn", turn]
    files = run(scene, *options)
    assert list(files) == [f"ball_{k:04d}.png" for k in range(3)]
    assert "3/3" in terminal.getvalue() and "frame" in terminal.getvalue()
    shown = [torch.cat([linear_to_srgb(unpremultiplied(image)), image.alpha[..., None]], -1) for image in frames]
    assert all(same_image(pixels(path), bytes_of(image)) for path, image in zip(files.values(), shown, strict=True))
    for path, image in zip(run(scene, *options, "--format", "exr").values(), frames, strict=True):
        torch.testing.assert_close(read_hdr_image(path), image.radiance, rtol=2**-10, atol=1e-6)
    (path,) = run(scene, *options, "--format", "webp").values()
    with Image.open(path) as animation:
        assert animation.n_frames == 3
        for k, image in enumerate(shown):
            animation.seek(k)
            got = torch.from_numpy(np.asarray(animation.convert("RGBA")).astype(np.float32) / 255)
            cover = image[..., 3:]
            errors = [float(((got - other)[..., :3] * cover).abs().mean()) for other in shown]
            assert errors[k] < 0.03 and errors[k] == min(errors), errors  # WebP loses detail


def test_diffuse_model_and_a_missing_light(scene, capsys):
    image = pixels(run(scene, light=None)["ball.png"])
    published = pixels(run(scene, "--diffuse-model", "published", light=None)["ball.png"])
    changed = published[..., :3].int() - image[..., :3].int()
    assert int(changed.max()) > 3 and int(changed.min()) >= -1  # more light at the rim, the same noise
    capsys.readouterr()
    light = str(scene / "none.hdr")
    assert main([str(scene / "ball.glb"), "--output", str(scene / "none"), "--light", light]) == 2
    output = capsys.readouterr()
    assert output.err.startswith("reli3d-render: ") and output.err.count("\n") == 1 and output.out == ""
    assert not (scene / "none").exists()


def test_planned_sample_counts_are_reported(scene, capsys):
    common = [str(scene / "ball.glb"), "--output", str(scene / "planned"), "--light", str(scene / "half.hdr")]
    assert main([*common, "--size", "16", "--plan", "16", "--json"]) == 0
    assert sum(json.loads(capsys.readouterr().out)["samples"]) <= 16
    assert main([*common, "--plan", "16", "--distance", "1e6"]) == 2
    assert "--plan: camera: expected the asset in view" in capsys.readouterr().err


@pytest.mark.parametrize("ending", ["webp", "gif", "mp4"])
def test_the_name_of_the_output_makes_an_animation(scene, tmp_path, ending):
    """Four frames of a turning light; the first shows the same as a single image."""
    if ending == "mp4":
        av = pytest.importorskip("av")
    path = tmp_path / f"turn.{ending}"
    places = [str(scene / "ball.glb"), "--light", str(scene / "half.hdr"), "--output", str(path)]
    options = ["--size", "48", "--frames", "4", "--turn", "light", "--quality", "draft", "--json"]
    output = io.StringIO()
    with contextlib.redirect_stdout(output):
        assert main(places + options) == 0
    expected = {"files": [str(path)], "frames": 4, "size": 48, "samples": [6, 12, 2], "supersampling": 1}
    assert json.loads(output.getvalue()) == expected
    assert [p.name for p in tmp_path.iterdir()] == [path.name]
    if ending == "mp4":
        with av.open(str(path)) as file:
            assert file.streams.video[0].average_rate == 24
            tags = file.streams.video[0].codec_context
            assert [tags.colorspace, tags.color_primaries, tags.color_trc, tags.color_range] == [1, 1, 1, 1]  # BT.709
            frames = [frame.to_image() for frame in file.decode(video=0)]
    else:
        image = Image.open(path)
        frames = [(image.seek(k), image.convert("RGBA"))[1] for k in range(image.n_frames)]
    assert len(frames) == 4 and frames[0].size == (48, 48)
    shown = [np.asarray(f.convert("RGB")).astype(float) for f in frames]
    middle = [v[20:28, 20:28].mean() for v in shown]
    assert max(middle) > 1.3 * min(middle)  # the light turns
    red = shown[0][24, 24]
    assert red[0] > 2 * red[1]  # in its colors: 4:2:0, 256 colors and lossy WebP keep a red ball red
    corner = np.asarray(frames[0])[1, 1]
    assert (corner[:3] > 250).all() if ending == "mp4" else corner[3] == 0


@pytest.mark.parametrize("name", ["seen.png", "seen.PNG", "linear.light.exr"])
def test_the_name_of_the_output_makes_one_image(scene, tmp_path, name):
    in_folder = run(scene, "--format", name[-3:].lower())
    (found,) = run(scene, "--output", str(tmp_path / name)).values()
    assert found == tmp_path / name
    assert found.read_bytes() == next(iter(in_folder.values())).read_bytes()
    layers = run(scene, "--output", str(tmp_path / name), "--aovs")
    assert f"{found.stem}_normal.exr" in layers and len(layers) == 5
