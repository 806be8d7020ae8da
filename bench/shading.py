"""Direct light of a sphere of 82 thousand triangles with shadows, and its outline, against Mitsuba's llvm variant.

Mitsuba renders its ``principled`` material with as many samples a pixel in two strategies (``direct``: emitter and
BSDF): the same amount of work, not the same estimator.  Both sides trace primary rays, without a film.  Gradients: of
the sum of the image with respect to one base color and all texels of the map.

``python -m bench.shading`` prints the variance of the image and its gradients at equal samples, of one formula on both
sides, and the ratio of times at equal variance.
"""

import sys
from functools import partial
from itertools import product

import numpy as np
import torch
import trimesh

from bench.peers.mitsuba_llvm import mitsuba
from bench.peers.mitsuba_material import material
from bench.timing import time_steps
from reli3d.geometry.camera import Camera, camera_rays, look_at
from reli3d.geometry.rays import RayScene
from reli3d.render.environment import Environment
from reli3d.render.points import SurfacePoints
from reli3d.render.shading import ShadeOptions, shade
from reli3d.render.silhouette import antialias, mesh_edges

SAMPLES = (20, 40, 4)  # the published counts: 64


def geometry():
    mesh = trimesh.creation.icosphere(subdivisions=6, radius=0.8)
    return mesh.vertices.astype(np.float32), mesh.faces.astype(np.int32)


def view(device, size):
    eye = torch.tensor([0.0, 0.5, 2.2], device=device)
    pose = look_at(eye, torch.zeros(3, device=device), torch.tensor([0.0, 1.0, 0.0], device=device))
    return Camera.from_fov(pose, 0.8, size, size)


def sky(device):
    return torch.rand(64, 128, 3, generator=torch.Generator().manual_seed(0)).to(device)


def direct(device, size, roughness, backward):
    """Primary rays and 64 samples with shadow rays per hit, with gradients to material and light if ``backward``."""
    vertices, faces = (torch.from_numpy(a).to(device) for a in geometry())
    scene, camera = RayScene(vertices, faces), view(device, size)
    origins, directions = (v.reshape(-1, 3) for v in camera_rays(camera))
    hit = int((scene.closest(origins, directions).face >= 0).sum())
    base = torch.tensor([0.7, 0.4, 0.2], device=device).requires_grad_(backward)
    light = sky(device).requires_grad_(backward)
    environment = Environment(light)
    _ = environment.cdf  # Mitsuba's is made when its scene loads

    def step(seed=0):
        found = scene.closest(origins, directions)
        index = torch.nonzero(found.face >= 0)[:, 0]
        wo, n = -directions[index], len(index)
        position = origins[index] + directions[index] * found.t[index, None]
        normal = torch.nn.functional.normalize(position, dim=-1)
        points = SurfacePoints(position, normal, normal, base.expand(n, 3), roughness, 0.0)
        out = shade(points, wo, environment, scene=scene, options=ShadeOptions(samples=SAMPLES, seed=seed))
        return torch.autograd.grad(out.sum(), (base, light)) if backward else out

    return step, {"samples": hit * sum(SAMPLES)}


def mitsuba_direct(device, size, roughness, backward, formula=None):
    """The same image from Mitsuba; CPU only, None without LLVM 19 or newer.  formula: ``(mi, base color)`` to a
    material's dictionary instead of ``principled``."""
    mi = mitsuba(device)
    if mi is None:
        return None
    import drjit as dr

    vertices, faces = geometry()
    mesh = mi.Mesh("ball", len(vertices), len(faces))
    params = mi.traverse(mesh)
    params["vertex_positions"], params["faces"] = vertices.ravel(), faces.ravel().astype(np.uint32)
    params.update()
    principled = {
        "type": "principled",
        "base_color": {"type": "rgb", "value": [0.7, 0.4, 0.2]},
        "roughness": roughness,
        "metallic": 0.0,
        "specular": 0.5,
    }
    color = mi.Color3f(0.7, 0.4, 0.2)
    if formula and backward:
        dr.enable_grad(color)
    mesh.set_bsdf(mi.load_dict(formula(mi, color) if formula else principled))
    bitmap = mi.Bitmap(sky(device).numpy())
    scene = mi.load_dict(
        {
            "type": "scene",
            "mesh": mesh,
            "light": {"type": "envmap", "bitmap": bitmap},
            "integrator": {"type": "direct", "emitter_samples": 32, "bsdf_samples": 32, "hide_emitters": True},
        }
    )
    origins, directions = (v.reshape(-1, 3).contiguous().numpy().T for v in camera_rays(view(device, size)))
    ray = mi.RayDifferential3f(mi.Point3f(origins), mi.Vector3f(directions))

    leaves = []
    if backward:
        params = mi.traverse(scene)
        leaves, keys = [color, mi.TensorXf(params["light.data"])], ["light.data"]
        if not formula:
            keys.insert(0, next(k for k in params.keys() if k.endswith("base_color.value")))  # noqa: SIM118  not a dict
            leaves[0] = mi.Color3f(params[keys[0]])
        for key, leaf in zip(keys, leaves[-len(keys) :], strict=True):
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
PEERS = {"direct": ("mitsuba", mitsuba_direct), "direct_grad": ("mitsuba", mitsuba_direct)}


def _own_formula(roughness, mi, base):
    """Our material as a Mitsuba one: variances are compared of one integrand."""
    return material(mi, base, roughness**2, 0.0)


def _noise(runs) -> float:
    """Sum of variances over the sum of squared means, of runs ``(R, ...)``."""
    runs = np.stack(runs).astype(np.float64)
    return float(runs.var(0, ddof=1).sum() / (runs.mean(0) ** 2).sum())


def _folded(texels: np.ndarray) -> np.ndarray:
    """Mitsuba keeps a column of the other end on either side of its map; their gradients belong to one texel."""
    out = texels[:, 1:-1].copy()
    out[:, -1] += texels[:, 0]
    out[:, 0] += texels[:, -1]
    return out


def equal_variance(write) -> None:
    """Print variances of 64 runs at 64 samples on either side, and times, ours by Mitsuba's, equal in either."""
    device, size, runs, time = torch.device("cpu"), 64, 64, {}
    for case in product((0.1, 0.4, 0.9), (False, True)):
        # Mitsuba's own material, and before the other is there: traced by Python, it slows down all scenes by a fifth
        ours, theirs = time_steps([f(device, 128, *case)[0] for f in (direct, mitsuba_direct)], device, seconds=2.0)
        time[case] = theirs.median / ours.median
    for roughness in (0.1, 0.4, 0.9):
        formula, pairs = partial(_own_formula, roughness), {}
        ours, theirs = (
            direct(device, size, roughness, False)[0],
            mitsuba_direct(device, size, roughness, False, formula)[0],
        )
        b = np.stack([np.array(theirs(k + 1)).T for k in range(runs)])
        pairs["image"] = _noise([ours(k).numpy() for k in range(runs)]), _noise(b[:, b.mean((0, 2)) > 0.0])
        ours, theirs = (
            direct(device, size, roughness, True)[0],
            mitsuba_direct(device, size, roughness, True, formula)[0],
        )
        a, b = ([step(k + 1) for k in range(runs)] for step in (ours, theirs))
        pairs["base color"] = _noise([g[0].numpy() for g in a]), _noise([np.array(g[0]).ravel() for g in b])
        pairs["texels"] = _noise([g[1].numpy() for g in a]), _noise([_folded(np.array(g[1])) for g in b])
        for what, (ours, theirs) in pairs.items():
            faster = time[roughness, what != "image"]
            write(
                f"roughness {roughness}, {what}: variance over squared mean, 64 samples: ours {ours:.3e}, Mitsuba "
                f"{theirs:.3e}, {theirs / ours:.2f} times; time {faster:.2f} times less at equal samples, "
                f"{faster * theirs / ours:.2f} at equal variance\n"
            )


if __name__ == "__main__":
    equal_variance(sys.stdout.write)
