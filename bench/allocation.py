"""Planning the counts of direct light's strategies, and what it gains at equal time.

``python -m bench.allocation`` renders the ball of ``bench.shading`` with shadows, 128 x 128, in 18 scenes, with 64
samples a pixel by the plan's counts, by the published counts (visible normals in pairs) and by each strategy alone, and
prints variance times time: CPU time of one thread, least of the runs; the plan's own is added to the plan's.
"""

import sys
import time

import torch

from bench.shading import SAMPLES, geometry, view
from reli3d.geometry.rays import RayScene
from reli3d.render.allocation import plan_samples
from reli3d.render.camera import camera_rays
from reli3d.render.environment import Environment
from reli3d.render.shading import shade

RUNS = 4  # of 10 thousand pixels each
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
                for _ in range(2):
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
                own = variance[chosen] * (spent[chosen] + pilot)
                best = min(SINGLE, key=cost.get)
                per = 1e9 / len(points[0]) / 64
                say(f"{name} {roughness} {metallic}: {chosen} variance {variance[chosen]:.2e}, plan "
                    f"{1e3 * pilot:.0f} ms, image {1e3 * spent[chosen]:.0f} ms; variance x time, plan over "
                    f"published {own / cost[SAMPLES]:.2g}, over the best strategy {best} {own / cost[best]:.3g}; ns a "
                    f"sample {[round(per * spent[c]) for c in (SAMPLES, *SINGLE)]}\n")  # fmt: skip


if __name__ == "__main__":
    study()
