"""Direct light of a sphere of 82 thousand triangles with shadows, and its outline, beside Mitsuba's llvm variant.

Mitsuba renders its own ``principled`` material with as many samples a pixel in two strategies (``direct``: emitter and
BSDF), primary rays included on both sides: the same amount of work, not the same estimator.  Its film pays for nothing
here: rays are given and radiance is returned.  With gradients both sides differentiate the sum of the image with
respect to one base colour and all texels of the map.

``python -m bench.shading`` prints what the cases do not: variance at equal samples and of one formula on both sides,
hence the ratio at equal variance, memory a pixel, and how time grows with pixels, samples and triangles.
"""

import glob
import os
import sys
from functools import partial

import numpy as np
import torch
import trimesh

from bench.timing import time_steps
from reli3d.geometry.rays import RayScene
from reli3d.render.camera import Camera, camera_rays, look_at
from reli3d.render.environment import Environment
from reli3d.render.shading import shade
from reli3d.render.silhouette import antialias, mesh_edges

SAMPLES = (20, 40, 4)  # the published counts: 64


def geometry(subdivisions=6):
    mesh = trimesh.creation.icosphere(subdivisions=subdivisions, radius=0.8)
    return mesh.vertices.astype(np.float32), mesh.faces.astype(np.int32)


def view(device, size):
    eye = torch.tensor([0.0, 0.5, 2.2], device=device)
    pose = look_at(eye, torch.zeros(3, device=device), torch.tensor([0.0, 1.0, 0.0], device=device))
    return Camera.from_fov(pose, 0.8, size, size)


def sky(device):
    return torch.rand(64, 128, 3, generator=torch.Generator().manual_seed(0)).to(device)


def direct(device, size, roughness, backward, samples=SAMPLES, subdivisions=6):
    """Primary rays and 64 samples with shadow rays per hit, with gradients to material and light if ``backward``."""
    vertices, faces = (torch.from_numpy(a).to(device) for a in geometry(subdivisions))
    scene, camera = RayScene(vertices, faces), view(device, size)
    origins, directions = (v.reshape(-1, 3) for v in camera_rays(camera))
    hit = int((scene.closest(origins, directions).face >= 0).sum())
    base = torch.tensor([0.7, 0.4, 0.2], device=device).requires_grad_(backward)
    light = sky(device).requires_grad_(backward)
    environment = Environment(light)
    _ = environment.table  # Mitsuba's is made when its scene loads

    def step(seed=0):
        found = scene.closest(origins, directions)
        index = torch.nonzero(found.face >= 0)[:, 0]
        wo, n = -directions[index], len(index)
        position = origins[index] + directions[index] * found.t[index, None]
        normal = torch.nn.functional.normalize(position, dim=-1)
        rough = torch.full((n,), roughness, device=device)
        out = shade(position, normal, normal, wo, base.expand(n, 3), rough, torch.zeros_like(rough), environment,
                    samples=samples, scene=scene, seed=seed)  # fmt: skip
        return torch.autograd.grad(out.sum(), (base, light)) if backward else out

    return step, {"samples": hit * sum(samples)}


def mitsuba_direct(device, size, roughness, backward, formula=None):
    """The same image from Mitsuba; CPU only, None without LLVM 19 or newer.  formula: ``(mi)`` to a material's
    dictionary instead of ``principled``."""
    found = sorted(glob.glob("/usr/lib/*/libLLVM-19.so*") + glob.glob("/usr/lib/*/libLLVM-2?.so*"))
    if device.type != "cpu" or not ("DRJIT_LIBLLVM_PATH" in os.environ or found):
        return None
    os.environ.setdefault("DRJIT_LIBLLVM_PATH", found[0] if found else "")
    try:
        import mitsuba as mi
    except ImportError:
        return None
    import drjit as dr

    mi.set_variant("llvm_ad_rgb")
    vertices, faces = geometry()
    mesh = mi.Mesh("ball", len(vertices), len(faces))
    params = mi.traverse(mesh)
    params["vertex_positions"], params["faces"] = vertices.ravel(), faces.ravel().astype(np.uint32)
    params.update()
    principled = {"type": "principled", "base_color": {"type": "rgb", "value": [0.7, 0.4, 0.2]},
                  "roughness": roughness, "metallic": 0.0, "specular": 0.5}  # fmt: skip
    mesh.set_bsdf(mi.load_dict(formula(mi) if formula else principled))
    bitmap = mi.Bitmap(sky(device).numpy())
    scene = mi.load_dict({"type": "scene", "mesh": mesh, "light": {"type": "envmap", "bitmap": bitmap},
                          "integrator": {"type": "direct", "emitter_samples": 32, "bsdf_samples": 32,
                                         "hide_emitters": True}})  # fmt: skip
    origins, directions = (v.reshape(-1, 3).contiguous().numpy().T for v in camera_rays(view(device, size)))
    ray = mi.RayDifferential3f(mi.Point3f(origins), mi.Vector3f(directions))

    leaves = []
    if backward:
        params = mi.traverse(scene)
        color_key = next(k for k in params.keys() if k.endswith("base_color.value"))  # noqa: SIM118  not a dict
        leaves = [mi.Color3f(params[color_key]), mi.TensorXf(params["light.data"])]
        for key, leaf in zip((color_key, "light.data"), leaves, strict=True):
            dr.enable_grad(leaf)
            params[key] = leaf
        params.update()

    def step(seed=0):
        sampler = mi.load_dict({"type": "independent"})
        sampler.seed(seed, size * size)
        color, _, _ = scene.integrator().sample(scene, sampler, ray)
        if not backward:
            dr.eval(color)
            dr.sync_thread()
            return color
        for leaf in leaves:
            dr.set_grad(leaf, 0.0)
        # the edges from the leaves to the scene were recorded once and stay for the next step
        dr.backward(dr.sum(color.x + color.y + color.z), flags=dr.ADFlag.ClearVertices)
        grads = [dr.grad(leaf) for leaf in leaves]
        dr.eval(*grads)
        dr.sync_thread()
        return grads

    return step, {"samples": size * size * 64}


def outline(device, size):
    """Antialiasing of a mask and its gradient to 41 thousand vertices."""
    vertices, faces = (torch.from_numpy(a).to(device) for a in geometry())
    scene, camera, edges = RayScene(vertices, faces), view(device, size), mesh_edges(vertices, faces)
    mask = (scene.closest(*camera_rays(camera)).face >= 0).float()[..., None]
    moving = vertices.clone().requires_grad_()

    def step():
        out = antialias(mask, moving, faces, camera, scene, edges=edges)
        return torch.autograd.grad(out.sum(), moving)

    return step, {"pixels": size * size}


CASES = {
    "direct": (direct, dict(size=128, roughness=0.4, backward=False)),
    "direct_grad": (direct, dict(size=128, roughness=0.4, backward=True)),
    "outline_grad": (outline, dict(size=512)),
}
PEERS = {"direct": mitsuba_direct, "direct_grad": mitsuba_direct}


def _own_formula(roughness, mi):
    """Our material as a Mitsuba one: variances are compared of one integrand."""
    from tests import mitsuba_scene

    return mitsuba_scene.material(mi, (0.7, 0.4, 0.2), roughness**2, 0.0)


def study() -> None:
    """Print variance, memory and growth; CPU."""
    device, size, say = torch.device("cpu"), 64, sys.stdout.write
    for roughness in (0.1, 0.4, 0.9):
        ours, _ = direct(device, size, roughness, False)
        theirs, _ = mitsuba_direct(device, size, roughness, False, partial(_own_formula, roughness))
        a = np.stack([ours(k).numpy() for k in range(32)])
        b = np.stack([np.array(theirs(k + 1)).T for k in range(32)])
        b = b[:, b.mean((0, 2)) > 0.0]
        ours, theirs = (v.var(0, ddof=1).mean() / v.mean() ** 2 for v in (a, b))
        say(f"roughness {roughness}: variance over squared mean, 64 samples: ours {ours:.3e}, Mitsuba {theirs:.3e}\n")
    base = dict(size=128, roughness=0.4, backward=False)
    changes = [{}, {"size": 256}, {"size": 512}, {"samples": (5, 10, 1)}, {"samples": (80, 160, 16)}]
    changes += [{"subdivisions": 4}, {"subdivisions": 7}, {"backward": True}, {"backward": True, "size": 256}]
    for change in changes:
        step, work = direct(device, **{**base, **change})
        timing = time_steps([step], device, seconds=1.0)[0]
        rate, pixels = work["samples"] / timing.median / 1e6, change.get("size", base["size"]) ** 2
        say(f"{change or 'the case'}: {1e3 * timing.median:.1f} ms, {rate:.2f} M samples/s, "
            f"{timing.peak_bytes / pixels:.0f} bytes a pixel\n")  # fmt: skip


if __name__ == "__main__":
    study()
