"""A reconstruction as three.js, model-viewer and Blender show it, and as we do, from one camera.

Each client loads ``mesh.glb`` and the light in its usual way: nothing is turned.  model-viewer is npm's: ``npm install
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
from reli3d.io.glb import read_glb
from reli3d.render.color import linear_to_srgb
from reli3d.render.environment import Environment
from reli3d.render.image import render_asset
from reli3d.render.shading import ShadeOptions
from tests.support.browser import chromium, pixels, served, show

THREE = Path(reli3d.__file__).parent / "assets" / "viewer" / "three.min.js"


@dataclass(frozen=True)
class Viewpoint:
    """A square image of the origin; angles in degrees."""

    size: int = 256
    fov: float = 32.0
    azimuth: float = 40.0
    elevation: float = 15.0
    distance: float = 2.6

    @property
    def eye(self) -> np.ndarray:
        a, e = math.radians(self.azimuth), math.radians(self.elevation)
        return self.distance * np.array([math.sin(a) * math.cos(e), math.sin(e), math.cos(a) * math.cos(e)])


def ours(glb: Path, light: Environment, viewpoint: Viewpoint, samples: tuple[int, int, int]) -> np.ndarray:
    """RGBA ``(H, W, 4)`` in [0, 255], sRGB, as all others are."""
    pose = look_at(torch.tensor(viewpoint.eye, dtype=torch.float32), torch.zeros(3), torch.tensor([0.0, 1.0, 0.0]))
    camera = Camera.from_fov(pose, math.radians(viewpoint.fov), viewpoint.size, viewpoint.size)
    image = render_asset(read_glb(glb), camera, light, options=ShadeOptions(samples=samples), supersampling=2)
    color = linear_to_srgb((image.radiance / image.alpha[..., None].clamp(min=1e-6)).clamp(0, 1))
    return 255.0 * torch.cat([color, image.alpha[..., None]], -1).numpy()


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
  window.rendering = renderer.domElement.toDataURL()
})
</script>"""

MODEL_VIEWER_PAGE = """<!doctype html><link rel="icon" href="data:,">
<script type="module" src="model-viewer.min.js"></script>
<style>body { margin: 0 } model-viewer { width: %(size)dpx; height: %(size)dpx }</style>
<model-viewer src="mesh.glb" environment-image="environment.hdr"
 camera-orbit="%(azimuth)sdeg %(polar)sdeg %(distance)sm"
 camera-target="0m 0m 0m" field-of-view="%(fov)sdeg" max-field-of-view="90deg" min-camera-orbit="auto auto 0m"
 max-camera-orbit="auto auto 9m" interaction-prompt="none" tone-mapping="none"
 shadow-intensity="0" interpolation-decay="1"></model-viewer>
<script>
const viewer = document.querySelector('model-viewer')
viewer.addEventListener('load', () => setTimeout(() => { window.rendering = viewer.toDataURL('image/png') }, 1000))
</script>"""


def _shown(folder: Path, page: str, viewpoint: Viewpoint) -> np.ndarray:
    values = {
        **vars(viewpoint),
        "polar": 90.0 - viewpoint.elevation,
        "eye": ", ".join(f"{v:.6f}" for v in viewpoint.eye),
    }
    (folder / "index.html").write_text(page % values)
    with chromium() as tab, served(folder) as url:
        show(tab, f"{url}/index.html", size=(viewpoint.size, viewpoint.size), ready="window.rendering")
        return pixels(tab.evaluate("window.rendering")).astype(np.float64)


def three_js(folder: Path, viewpoint: Viewpoint) -> np.ndarray:
    """``folder`` holds ``mesh.glb``, ``environment.hdr`` and ``.exr``, and receives the client's files."""
    shutil.copy(THREE, folder)
    return _shown(folder, THREE_PAGE, viewpoint)


def model_viewer(folder: Path, viewpoint: Viewpoint) -> np.ndarray:
    modules = os.environ.get("RELI3D_MODEL_VIEWER")
    if modules is None:
        pytest.skip("needs npm's @google/model-viewer in the folder RELI3D_MODEL_VIEWER")
    shutil.copy(Path(modules) / "@google" / "model-viewer" / "dist" / "model-viewer.min.js", folder)
    return _shown(folder, MODEL_VIEWER_PAGE, viewpoint)


BLENDER = """
import math, sys
import bpy
from mathutils import Matrix, Vector
folder, eye, fov, size = sys.argv[1], eval(sys.argv[2]), float(sys.argv[3]), int(sys.argv[4])
bpy.ops.wm.read_factory_settings(use_empty=True)
path = folder + "/" + sys.argv[5]
load = {"glb": bpy.ops.import_scene.gltf, "usdz": bpy.ops.wm.usd_import, "obj": bpy.ops.wm.obj_import}
load[path.rsplit(".", 1)[1]](filepath=path)
for image in bpy.data.images:
    if path.endswith("obj") and ("roughness" in image.name or "metallic" in image.name):
        image.colorspace_settings.name = "Non-Color"  # as in docs/guide.md
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


def blender(folder: Path, viewpoint: Viewpoint, mesh: str = "mesh.glb") -> np.ndarray:
    """``mesh``: the file of ``folder`` that is loaded, ``.glb``, ``.usdz`` or ``.obj``."""
    place = os.environ.get("RELI3D_BPY")
    if place is None:
        pytest.skip("needs PyPI's bpy in the folder RELI3D_BPY")
    options = [str(folder), str(viewpoint.eye.tolist()), str(viewpoint.fov), str(viewpoint.size), mesh]
    command = [sys.executable, "-c", BLENDER, *options]
    environment = {**os.environ, "PYTHONPATH": place}
    done = subprocess.run(command, capture_output=True, text=True, env=environment, timeout=600)
    assert (folder / "blender.png").exists(), done.stderr
    return np.asarray(Image.open(folder / "blender.png").convert("RGBA")).astype(np.float64)
