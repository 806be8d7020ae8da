"""Mitsuba 3 with its llvm variant where it runs, and its step of a fit: the peer of ``bench.fit``."""

from __future__ import annotations

import glob
import os

import numpy as np
import torch

from reli3d.geometry.camera import Camera, camera_rays
from reli3d.geometry.mesh import Mesh


def mitsuba(device: torch.device):
    """The module with ``llvm_ad_rgb`` set; None on other devices, without the package, and without LLVM 19 or newer."""
    found = sorted(glob.glob("/usr/lib/*/libLLVM-19.so*") + glob.glob("/usr/lib/*/libLLVM-2?.so*"))
    if device.type != "cpu" or not ("DRJIT_LIBLLVM_PATH" in os.environ or found):
        return None
    os.environ.setdefault("DRJIT_LIBLLVM_PATH", found[0] if found else "")
    try:
        import mitsuba as mi
    except ImportError:
        return None
    mi.set_variant("llvm_ad_rgb")
    return mi


def fit_step(mi, mesh: Mesh, light: torch.Tensor, camera: Camera, material, target: float, samples: int, rate: float):
    """A step that moves the material at the vertices of ``mesh`` and the texels of ``light (H, W, 3)``.

    camera: of several views.  material: base color of all channels, roughness and metallic, before the first step.
    target: linear color of all photographs.  samples: of a pixel, in each of two strategies.
    """
    import drjit as dr

    count, (color, roughness, metallic) = len(mesh.vertices), material
    ball = mi.Mesh("ball", count, len(mesh.faces), has_vertex_normals=True)
    columns = {"color": (3, color), "roughness": (1, roughness), "metallic": (1, metallic)}
    for name, (width, value) in columns.items():
        ball.add_attribute(f"vertex_{name}", width, [value] * (width * count))
    values = mi.traverse(ball)
    values["vertex_positions"], values["vertex_normals"] = mesh.vertices.numpy().ravel(), mesh.normals.numpy().ravel()
    values["faces"] = mesh.faces.numpy().ravel().astype(np.uint32)
    values.update()
    look_up = {name: {"type": "mesh_attribute", "name": f"vertex_{name}"} for name in columns}
    bsdf = {"type": "principled", "base_color": look_up.pop("color"), "specular": 0.5, **look_up}
    ball.set_bsdf(mi.load_dict(bsdf))
    integrator = {"type": "direct", "emitter_samples": samples, "bsdf_samples": samples, "hide_emitters": True}
    sky = {"type": "envmap", "bitmap": mi.Bitmap(np.ascontiguousarray(light.numpy()))}
    scene = mi.load_dict({"type": "scene", "mesh": ball, "light": sky, "integrator": integrator})
    origins, directions = camera_rays(camera)
    columns = (v.expand_as(directions).reshape(-1, 3).contiguous().numpy().T for v in (origins, directions))
    ray = mi.RayDifferential3f(*(kind(v) for kind, v in zip((mi.Point3f, mi.Vector3f), columns, strict=True)))
    params = mi.traverse(scene)
    keys = [key for key in params.keys() if key.endswith(("color", "roughness", "metallic", "light.data"))]  # noqa: SIM118  not a dict
    if len(keys) != 4:
        raise RuntimeError(f"expected four parameters of Mitsuba's scene to fit, got {keys}")
    optimizer = mi.ad.Adam(lr=rate)
    for key in keys:
        optimizer[key] = params[key]
    params.update(optimizer)
    derivative = float(np.float32(1 / 2.2) * np.float32(target) ** np.float32(1 / 2.2 - 1))
    pixels = directions[..., 0].numel()

    def step():
        sampler = mi.load_dict({"type": "independent"})
        sampler.seed(0, pixels)
        image, hit, _ = scene.integrator().sample(scene, sampler, ray)
        residual = dr.select(hit, (image - target) * derivative, 0.0)
        dr.backward(dr.sum(dr.squared_norm(residual)))
        optimizer.step()
        params.update(optimizer)
        dr.eval(*(optimizer[key] for key in keys))
        dr.sync_thread()
        return [optimizer[key] for key in keys]

    return step
