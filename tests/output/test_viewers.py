"""A mirror ball under two lamps, as three.js, model-viewer and Blender load our files, beside our renderer.

Each client loads the files in its usual way: nothing is turned.  model-viewer is npm's: ``npm install
@google/model-viewer`` in any folder outside the checkout, then set RELI3D_MODEL_VIEWER to its ``node_modules``; Blender
is PyPI's bpy: set RELI3D_BPY to a folder with it (``pip install --target``).
"""

import math
import os
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

import reli3d
from reli3d.geometry.camera import Camera, look_at
from reli3d.io.glb import read_glb, write_glb
from reli3d.io.hdr import read_environment, write_environment
from reli3d.render.asset import Asset, TextureSet
from reli3d.render.color import linear_to_srgb
from reli3d.render.environment import Environment
from reli3d.render.render import render
from reli3d.render.shading import ShadeOptions
from tests.support.browser import chromium, pixels, served
from tests.support.scenes import ball_mesh

SIZE, FOV, AZIMUTH, ELEVATION, DISTANCE = 256, 32.0, 40.0, 15.0, 2.6  # degrees; the view of every client
THREE = Path(reli3d.__file__).parent / "assets" / "viewer" / "three.min.js"
LAMPS = {0: (0.55, 0.45, 0.7), 1: (0.9, 0.1, -0.25)}  # red and green: channel and direction
EYE = DISTANCE * np.array(
    [
        math.sin(math.radians(AZIMUTH)) * math.cos(math.radians(ELEVATION)),
        math.sin(math.radians(ELEVATION)),
        math.cos(math.radians(AZIMUTH)) * math.cos(math.radians(ELEVATION)),
    ]
)


@dataclass(frozen=True)
class Seen:
    mask: np.ndarray  # (H, W) bool
    color: np.ndarray  # (H, W, 3) in [0, 255]

    def highlight(self, channel: int) -> np.ndarray:
        """Pixel (x, y) of the middle of what shines in one channel only."""
        weight = self.color[..., channel] - self.color[..., 1 - channel] - 30.0  # above the blur of either lamp
        weight = weight.clip(min=0.0) * self.mask
        assert weight.sum() > 0, "no highlight"
        y, x = np.mgrid[0:SIZE, 0:SIZE] + 0.5
        return np.array([(x * weight).sum(), (y * weight).sum()]) / weight.sum()


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """``mesh.glb``, ``environment.hdr`` and ``.exr`` as the command writes them."""
    folder = tmp_path_factory.mktemp("viewers")
    write_glb(folder / "mesh.glb", Asset(ball_mesh(5, 0.6), TextureSet(torch.ones(4, 4, 3), 0.0, 1.0)))
    light = torch.full((256, 512, 3), 0.02)  # three.js makes cubes of a quarter of the width
    column, row = (torch.arange(512) + 0.5) / 512, (torch.arange(256) + 0.5) / 256
    theta, phi = 2 * math.pi * column - math.pi, math.pi * row[:, None]
    d = torch.stack([theta.sin() * phi.sin(), phi.cos().expand(256, 512), -theta.cos() * phi.sin()], -1)
    for channel, at in LAMPS.items():
        axis = torch.nn.functional.normalize(torch.tensor(at), dim=0)
        light[..., channel] += 0.8 * torch.exp(200.0 * (d @ axis - 1.0))
    for suffix in ("hdr", "exr"):
        write_environment(folder / f"environment.{suffix}", light)
    return folder


@pytest.fixture(scope="module")
def ours(folder) -> Seen:
    return rendered(folder / "mesh.glb", Environment(read_environment(folder / "environment.exr")))


def rendered(glb: Path, light: Environment) -> Seen:
    pose = look_at(torch.tensor(EYE, dtype=torch.float32), torch.zeros(3), torch.tensor([0.0, 1.0, 0.0]))
    camera = Camera.from_fov(pose, math.radians(FOV), SIZE, SIZE)
    image = render(read_glb(glb), camera, light, options=ShadeOptions((0, 12, 0)), supersampling=2)  # a mirror: GGX
    color = linear_to_srgb((image.radiance / image.alpha[..., None].clamp(min=1e-6)).clamp(0, 1))
    return Seen(image.alpha.numpy() > 0.5, 255.0 * color.numpy())


def agree(got: Seen, want: Seen) -> None:
    union, both = (got.mask | want.mask).sum(), (got.mask & want.mask).sum()
    assert both / union > 0.99  # the rim of a disc of 170 pixels is 1 % of it
    for channel in LAMPS:
        off = np.abs(got.highlight(channel) - want.highlight(channel))
        assert off.max() < 2.0, f"highlight of channel {channel}: off by {off} pixels"


def test_a_light_turned_by_ten_degrees_would_be_seen(folder, ours):
    """The comparison's own power; also that the usual mistakes, a quarter turn or a mirrored map, are far off."""
    light = Environment(read_environment(folder / "environment.exr"))
    for wrong in (
        light.rotated(math.radians(10.0)),
        light.rotated(math.pi / 2),
        Environment(light.radiance.flip(1).contiguous()),
    ):
        with pytest.raises(AssertionError, match="highlight"):
            agree(rendered(folder / "mesh.glb", wrong), ours)


def of_rgba(rgba: np.ndarray) -> Seen:
    return Seen(rgba[..., 3] > 127, rgba[..., :3].astype(np.float64))


THREE_PAGE = """<!doctype html><link rel="icon" href="data:,"><script src="three.min.js"></script><script>
const { Scene, PerspectiveCamera, WebGLRenderer, GLTFLoader, HDRLoader } = THREE
const scene = new Scene(), camera = new PerspectiveCamera(%(fov)s, 1, 0.1, 10)
camera.position.set(%(eye)s)
camera.lookAt(0, 0, 0)
const renderer = new WebGLRenderer({ alpha: true, antialias: true, preserveDrawingBuffer: true })
renderer.setSize(%(size)d, %(size)d)
const files = [new GLTFLoader().loadAsync('mesh.glb'), new HDRLoader().loadAsync('environment.hdr')]
Promise.all(files).then(([gltf, map]) => {
  map.mapping = THREE.EquirectangularReflectionMapping
  scene.environment = map
  scene.add(gltf.scene)
  renderer.render(scene, camera)
  window.picture = renderer.domElement.toDataURL()
})
</script>"""

MODEL_VIEWER_PAGE = """<!doctype html><link rel="icon" href="data:,">
<script type="module" src="model-viewer.min.js"></script>
<style>body { margin: 0 } model-viewer { width: %(size)dpx; height: %(size)dpx }</style>
<model-viewer src="mesh.glb" environment-image="environment.hdr"
 camera-orbit="%(azimuth)sdeg %(polar)sdeg %(distance)sm"
 camera-target="0m 0m 0m" field-of-view="%(fov)sdeg" max-field-of-view="90deg" min-camera-orbit="auto auto 0m"
 max-camera-orbit="auto auto 9m" interaction-prompt="none" shadow-intensity="0" interpolation-decay="1"></model-viewer>
<script>
const viewer = document.querySelector('model-viewer')
viewer.addEventListener('load', () => setTimeout(() => { window.picture = viewer.toDataURL('image/png') }, 1000))
</script>"""
VALUES = {
    "size": SIZE,
    "fov": FOV,
    "azimuth": AZIMUTH,
    "polar": 90.0 - ELEVATION,
    "distance": DISTANCE,
    "eye": ", ".join(f"{v:.6f}" for v in EYE),
}


def shown(folder: Path, page: str) -> Seen:
    (folder / "index.html").write_text(page % VALUES)
    with chromium() as tab, served(folder) as url:
        tab.open(f"{url}/index.html", size=(SIZE, SIZE)).wait("window.picture")
        return of_rgba(pixels(tab.ask("window.picture")))


def test_three_js_shows_the_light_where_we_do(folder, ours):
    shutil.copy(THREE, folder)
    agree(shown(folder, THREE_PAGE), ours)


def test_model_viewer_shows_the_light_where_we_do(folder, ours):
    modules = os.environ.get("RELI3D_MODEL_VIEWER")
    if modules is None:
        pytest.skip("needs npm's @google/model-viewer in the folder RELI3D_MODEL_VIEWER")
    shutil.copy(Path(modules) / "@google" / "model-viewer" / "dist" / "model-viewer.min.js", folder)
    agree(shown(folder, MODEL_VIEWER_PAGE), ours)


BLENDER = """
import math, sys
import bpy
from mathutils import Matrix, Vector
folder, eye, fov, size = sys.argv[1], eval(sys.argv[2]), float(sys.argv[3]), int(sys.argv[4])
bpy.ops.wm.read_factory_settings(use_empty=True)
bpy.ops.import_scene.gltf(filepath=folder + "/mesh.glb")
scene = bpy.context.scene
scene.world = bpy.data.worlds.new("light")
scene.world.use_nodes = True
nodes = scene.world.node_tree.nodes
texture = nodes.new("ShaderNodeTexEnvironment")
texture.image = bpy.data.images.load(folder + "/environment.exr")
scene.world.node_tree.links.new(texture.outputs["Color"], nodes["Background"].inputs["Color"])
camera = bpy.data.cameras.new("camera")
camera.sensor_fit, camera.angle = "HORIZONTAL", math.radians(fov)
holder = bpy.data.objects.new("camera", camera)
holder.location = (eye[0], -eye[2], eye[1])  # glTF's +Y is Blender's +Z
holder.rotation_euler = (-holder.location).to_track_quat("-Z", "Y").to_euler()
scene.collection.objects.link(holder)
scene.camera = holder
scene.render.engine = "CYCLES"
scene.cycles.samples = 32
scene.cycles.use_denoising = False
scene.render.film_transparent = True
scene.render.resolution_x = scene.render.resolution_y = size
scene.view_settings.view_transform = "Standard"
scene.render.filepath = folder + "/blender.png"
bpy.ops.render.render(write_still=True)
"""


def test_blender_shows_the_light_where_we_do(folder, ours):
    place = os.environ.get("RELI3D_BPY")
    if place is None:
        pytest.skip("needs PyPI's bpy in the folder RELI3D_BPY")
    command = [sys.executable, "-c", BLENDER, str(folder), str(EYE.tolist()), str(FOV), str(SIZE)]
    environment = {**os.environ, "PYTHONPATH": place}
    done = subprocess.run(command, capture_output=True, text=True, env=environment, timeout=600)
    assert (folder / "blender.png").exists(), done.stderr
    agree(of_rgba(np.asarray(Image.open(folder / "blender.png").convert("RGBA"))), ours)
