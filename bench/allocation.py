"""Planning the counts of direct light's strategies, and what it gains at equal time.

``python -m bench.allocation`` renders the ball of ``bench.shading`` with shadows, 128 x 128, in 18 scenes, with 64
samples a pixel by the plan's counts, by the published counts (visible normals in pairs) and by each strategy alone, and
prints variance times time: CPU time of one thread, least of the runs; the plan's own is added to the plan's.

``python -m bench.allocation MESH.glb LIGHT.hdr``: variance of an image of 256 x 256 by both kinds of plan over that by
the published counts, of the radiance and of the picture (sRGB, mean brightness at 0.18).
"""

import math
import sys
import time
from pathlib import Path

import torch

from bench.shading import SAMPLES, geometry, view
from reli3d.geometry.rays import RayScene
from reli3d.io.glb import read_glb
from reli3d.io.hdr import read_environment
from reli3d.render.allocation import plan_samples
from reli3d.render.asset import Asset
from reli3d.render.camera import Camera, camera_rays, look_at
from reli3d.render.color import linear_to_srgb
from reli3d.render.environment import Environment
from reli3d.render.render import joined_scene, plan_render, render
from reli3d.render.shading import shade

RUNS = 3  # of 10 thousand pixels each
SINGLE = (64, 0, 0), (0, 64, 0), (0, 0, 64)


def lights(device):
    """Even light, a sky brighter above, and the sky with a sun of one texel, 2500 times as bright."""
    sky = 0.4 + 0.6 * torch.linspace(1, -1, 32)[:, None, None].clamp(min=0.0)
    sky = sky.expand(32, 64, 3).clone()
    sun = sky.clone()
    sun[7, 20] = 2000.0
    maps = {"constant": torch.full((32, 64, 3), 0.7), "sky": sky, "sun": sun}
    return {name: Environment(radiance.to(device)) for name, radiance in maps.items()}


def seen(device, size):
    """Positions, normals and views of the ball's pixels, and the ball for shadows."""
    vertices, faces = (torch.from_numpy(a).to(device) for a in geometry())
    scene = RayScene(vertices, faces)
    origins, directions = (v.reshape(-1, 3) for v in camera_rays(view(device, size)))
    hits = scene.closest(origins, directions)
    index = torch.nonzero(hits.face >= 0)[:, 0]
    position = origins[index] + directions[index] * hits.t[index, None]
    return position, torch.nn.functional.normalize(position, dim=-1), -directions[index], scene


def arguments(points, roughness, metallic):
    position, normal, wo, _ = points
    flat = torch.ones(len(position), device=position.device)
    base = position.new_tensor([0.7, 0.4, 0.2]).expand_as(position)
    return position, normal, normal, wo, base, flat * roughness, flat * metallic


def plan(device, size):
    """One plan of 64 samples for a glossy ball in the sun."""
    points, environment = seen(device, size), lights(device)["sun"]
    surface = arguments(points, 0.3, 1.0)
    _ = environment.table

    def step():
        return plan_samples(*surface, environment, scene=points[3])

    return step, {"plans": 1}


CASES = {"plan": (plan, dict(size=128))}


def study() -> None:
    """Print the table; CPU."""
    torch.set_num_threads(1)
    device, say = torch.device("cpu"), sys.stdout.write
    points = seen(device, 128)
    for name, environment in lights(device).items():
        for roughness in (0.05, 0.3, 1.0):
            for metallic in (0.0, 1.0):
                surface = arguments(points, roughness, metallic)
                planned, pilot = [], float("inf")
                for _ in range(3):
                    start = time.process_time()
                    planned.append(plan_samples(*surface, environment, scene=points[3]))
                    pilot = min(pilot, time.process_time() - start)
                chosen = planned[0].samples
                work = {chosen: [], SAMPLES: [], **{counts: [] for counts in SINGLE}}
                spent = {counts: float("inf") for counts in work}
                for seed in range(RUNS):
                    for counts, images in work.items():
                        start = time.process_time()
                        images.append(shade(*surface, environment, samples=counts, scene=points[3], seed=seed,
                                            antithetic=counts == SAMPLES))  # fmt: skip
                        spent[counts] = min(spent[counts], time.process_time() - start)
                variance = {c: float(torch.stack(v).double().var(0).sum(1).mean()) for c, v in work.items()}
                cost = {c: variance[c] * spent[c] for c in work}
                whole = 1.0 + pilot / spent[chosen]
                best = min(SINGLE, key=cost.get)
                over = [cost[chosen] / cost[c] for c in (SAMPLES, best)]
                per = 1e9 / len(points[0]) / 64
                say(f"{name} {roughness} {metallic}: {chosen} variance {variance[chosen]:.2e}, plan {1e3 * pilot:.0f} "
                    f"ms, image {1e3 * spent[chosen]:.0f} ms; variance x time with and without the plan's: over the "
                    f"published counts' {whole * over[0]:.2g} {over[0]:.2g}, over the best strategy's {best} "
                    f"{whole * over[1]:.2g} {over[1]:.2g}; ns a sample "
                    f"{[round(per * spent[c]) for c in (SAMPLES, *SINGLE)]}\n")  # fmt: skip


def images(glb: Path, light: Path) -> None:
    """Print how a picture of a real mesh under a real map gains; CPU."""
    torch.set_num_threads(1)
    parts, environment = [Asset(p.mesh, p.textures) for p in read_glb(glb)], Environment(read_environment(light))
    scene = joined_scene(parts)
    low, high = scene.vertices.amin(0), scene.vertices.amax(0)
    centre, radius = (low + high) / 2, float((high - low).norm()) / 2
    pose = look_at(centre + radius * torch.tensor([1.6, 1.3, 2.5]), centre, torch.tensor([0.0, 1.0, 0.0]))
    camera = Camera.from_fov(pose, math.radians(34.0), 256, 256)

    def variances(samples, antithetic):
        runs = [render(parts, camera, environment, scene=scene, samples=samples, antithetic=antithetic, seed=seed)
                for seed in range(RUNS)]  # fmt: skip
        radiance = torch.stack([r.radiance for r in runs])
        shown = linear_to_srgb(radiance * (0.18 / radiance[:, runs[0].alpha > 0.0].mean())).clamp(0.0, 1.0)
        return [float(v.double().var(0).mean()) for v in (radiance, shown)]

    published = variances(SAMPLES, True)
    for relative in (False, True):
        start = time.process_time()
        counts = plan_render(parts, camera, environment, scene=scene, relative=relative).samples
        spent = time.process_time() - start
        radiance, shown = (a / b for a, b in zip(variances(counts, False), published, strict=True))
        kind = "relative" if relative else "absolute"
        sys.stdout.write(f"{glb.stem} {light.stem} {kind} {counts}: variance over the published counts' "
                         f"{radiance:.2f}, of the picture {shown:.2f}; plan {1e3 * spent:.0f} ms\n")  # fmt: skip


if __name__ == "__main__":
    images(*map(Path, sys.argv[1:3])) if len(sys.argv) > 1 else study()
