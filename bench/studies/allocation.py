"""Planning the counts of direct light's strategies, and what it gains at equal time.

``python -m bench.studies.allocation [LIGHT ...]``: variance times time of the ball of ``bench.shading``, 128 x 128,
64 samples, in 18 scenes, by the plan, by the published counts and by each strategy alone.  Time: CPU seconds of one
thread, least of three, planning included.  Variance: 256 runs at 256 weighted pixels, half of them bright; 95 %
interval by bootstrap.  Where all runs missed the sun, quadrature gives its part.

``python -m bench.studies.allocation MESH.glb LIGHT.hdr``: variance of an image of 256 x 256 by both kinds of plan
over that by the published counts, of the radiance and of the picture (sRGB, mean brightness at 0.18).
"""

import math
import sys
import time
from functools import partial
from pathlib import Path

import torch

from bench.shading import SAMPLES, geometry, view
from reli3d.geometry.camera import Camera, camera_rays, look_at
from reli3d.geometry.rays import RayScene
from reli3d.io.glb import read_glb
from reli3d.io.hdr import read_environment
from reli3d.render.allocation import _pilot_points, plan_samples
from reli3d.render.asset import Asset
from reli3d.render.color import linear_to_srgb
from reli3d.render.environment import Environment
from reli3d.render.material import eval_bsdf, pdf_lobes
from reli3d.render.points import SurfacePoints
from reli3d.render.render import joined_scene, plan_render, render
from reli3d.render.shading import ShadeOptions, shade

RUNS = 256  # of a variance
IMAGES = 3  # timed; and of a variance over all pixels of a picture
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


def shaded(surface):
    """Points and views of :func:`arguments`, as ``shade`` takes them."""
    position, normal, ng, wo, *material = surface
    return SurfacePoints(position, ng, normal, *material), wo


def plan(device, size):
    """One plan of 64 samples for a glossy ball in the sun."""
    points, environment = seen(device, size), lights(device)["sun"]
    surface = arguments(points, 0.3, 1.0)
    _ = environment.table

    def step():
        return plan_samples(*shaded(surface), environment, scene=points[3])

    return step, {"plans": 1}


CASES = {"plan": (plan, dict(size=128))}


def study(names: list[str]) -> None:
    """Print the table for the lights of these names; CPU."""
    torch.set_num_threads(1)
    device, points = torch.device("cpu"), seen(torch.device("cpu"), 128)
    found = lights(device)
    for name in names:
        for roughness in (0.05, 0.3, 1.0):
            for metallic in (0.0, 1.0):
                row = measured(arguments(points, roughness, metallic), found[name], points[3])
                sys.stdout.write(f"{name} {roughness} {metallic}: {row}\n")
                sys.stdout.flush()


def measured(surface, environment, scene) -> str:
    """Variance times time of one scene, as text."""
    plans = [timed(lambda: plan_samples(*shaded(surface), environment, scene=scene)) for _ in range(IMAGES)]
    pilot, chosen = min(t for t, _ in plans), plans[0][1].samples
    spent = {counts: float("inf") for counts in (chosen, SAMPLES, *SINGLE)}
    for seed in range(IMAGES):
        for counts in spent:
            options = ShadeOptions(counts, seed, pairing(counts))
            step = partial(shade, *shaded(surface), environment, scene=scene, options=options)
            spent[counts] = min(spent[counts], timed(step)[0])
    drawn = variances(surface, environment, scene, list(spent))
    variance = {counts: float(v[0]) for counts, v in drawn.items()}
    best = min(SINGLE, key=lambda c: variance[c] * spent[c])
    text = f"{chosen} variance {variance[chosen]:.2e}, plan {1e3 * pilot:.0f} ms, image {1e3 * spent[chosen]:.0f} ms"
    for what, other in (("published", SAMPLES), ("best strategy", best)):
        ratio, whole = drawn[chosen] / drawn[other], (spent[chosen] + pilot) / spent[other]
        low, high = (whole * ratio[1:].quantile(ratio.new_tensor([0.025, 0.975]))).tolist()
        text += f"; variance x time over {what} {other} {whole * float(ratio[0]):.2g} ({low:.2g} to {high:.2g}), "
        text += f"without the plan's {spent[chosen] / spent[other] * float(ratio[0]):.2g}"
    return text + f"; ns a sample {[round(1e9 * spent[c] / len(surface[0]) / 64) for c in (SAMPLES, *SINGLE)]}"


def variances(surface, environment, scene, choices) -> dict[tuple[int, int, int], torch.Tensor]:
    """Variance of a pixel, mean over the image, and as 400 bootstraps over the runs see it: ``(401,)`` float64."""
    rows, share = _pilot_points(list(surface), environment, scene, ShadeOptions(seed=1))
    some, found = [v[rows] for v in surface], {}
    hidden = sun_part(some, environment) if bool(environment.radiance.max() > 10.0) else torch.zeros(len(rows), 3)
    picks = torch.randint(RUNS, (400, RUNS), generator=torch.Generator().manual_seed(0))
    weight = torch.zeros(400, RUNS, dtype=torch.float64).scatter_add_(1, picks, torch.ones(400, RUNS).double())
    weight = torch.cat([torch.ones(1, RUNS).double(), weight]) / RUNS
    for counts in choices:
        runs = independent(some, environment, scene, ShadeOptions(counts, antithetic=pairing(counts)))
        runs = (runs - runs.mean(0)).flatten(1)
        each = (weight @ runs.square() - (weight @ runs).square()).unflatten(1, (-1, 3)).sum(2) * (RUNS / (RUNS - 1))
        if counts in SINGLE:
            unseen = hidden[:, SINGLE.index(counts)]
            each = torch.where(each[0] < 0.01 * unseen, unseen, each)
        found[counts] = each @ share
    return found


def independent(surface, environment, scene, options) -> torch.Tensor:
    """Independent values ``(RUNS, N, 3)`` of ``shade``, float64."""
    repeated = [v.repeat(RUNS, *[1] * (v.ndim - 1)) for v in surface]
    return shade(*shaded(repeated), environment, scene=scene, options=options).double().reshape(RUNS, -1, 3)


def sun_part(surface, environment, height=512) -> torch.Tensor:
    """Variance ``(N, 3)`` that the sun adds to each point by each of :data:`SINGLE`, summed over the channels.

    By midpoints in cos theta and phi over what is brighter than 10: (int f^2 / p - (int f)^2) / 64.
    """
    _, _, normal, wo, base, roughness, metallic = surface
    y = (torch.arange(height, dtype=torch.float64) + 0.5) / height * 2 - 1
    phi = (torch.arange(2 * height, dtype=torch.float64) + 0.5) / height * torch.pi
    y, phi = torch.meshgrid(y, phi, indexing="ij")
    s = (1 - y * y).sqrt()
    d = torch.stack([s * phi.cos(), y, s * phi.sin()], -1).reshape(-1, 3).to(normal)
    angle = 4 * torch.pi / len(d)
    radiance = environment.lookup(d)
    d, radiance = (v[radiance.amax(1) > 10.0] for v in (d, radiance))
    table, rows = environment.pdf(d).double(), []
    for k in range(len(normal)):
        helper = torch.eye(3).to(normal)[normal[k].abs().argmin()]
        t = torch.nn.functional.normalize(torch.linalg.cross(helper, normal[k]), dim=-1)
        frame = torch.stack([t, torch.linalg.cross(normal[k], t), normal[k]])
        wi, o, alpha = d @ frame.T, frame @ wo[k], roughness[k] ** 2
        f = (eval_bsdf(o, wi, base[k], alpha, metallic[k]) * wi[:, 2:].clamp(min=0.0) * radiance).double()
        visible, _, cosine = pdf_lobes(o, wi, alpha).double().unbind(-1)
        p = torch.stack([table, visible, cosine], 1).clamp(min=1e-30)  # where a density is 0, so is f
        rows.append((angle * (f.square().sum(1, keepdim=True) / p).sum(0) - (angle * f.sum(0)).square().sum()) / 64)
    return torch.stack(rows)


def pairing(counts: tuple[int, int, int]) -> str:
    """The published counts as they are shipped, plans and single strategies without pairs."""
    return "opposite" if counts == SAMPLES else "none"


def timed(step) -> tuple[float, object]:
    start = time.process_time()
    value = step()
    return time.process_time() - start, value


def images(glb: Path, light: Path) -> None:
    """Print how a picture of a real mesh under a real map gains; CPU."""
    torch.set_num_threads(1)
    parts, environment = [Asset(p.mesh, p.textures) for p in read_glb(glb)], Environment(read_environment(light))
    scene = joined_scene(parts)
    low, high = scene.vertices.amin(0), scene.vertices.amax(0)
    centre, radius = (low + high) / 2, float((high - low).norm()) / 2
    pose = look_at(centre + radius * torch.tensor([1.6, 1.3, 2.5]), centre, torch.tensor([0.0, 1.0, 0.0]))
    camera = Camera.from_fov(pose, math.radians(34.0), 256, 256)

    def variances(counts):
        options = [ShadeOptions(counts, seed, pairing(counts)) for seed in range(IMAGES)]
        runs = [render(parts, camera, environment, scene=scene, options=o) for o in options]
        radiance = torch.stack([r.radiance for r in runs])
        shown = linear_to_srgb(radiance * (0.18 / radiance[:, runs[0].alpha > 0.0].mean())).clamp(0.0, 1.0)
        return [float(v.double().var(0).mean()) for v in (radiance, shown)]

    published = variances(SAMPLES)
    for relative in (False, True):
        start = time.process_time()
        counts = plan_render(parts, camera, environment, scene=scene, relative=relative).samples
        spent = time.process_time() - start
        radiance, shown = (a / b for a, b in zip(variances(counts), published, strict=True))
        kind = "relative" if relative else "absolute"
        sys.stdout.write(
            f"{glb.stem} {light.stem} {kind} {counts}: variance over the published counts' "
            f"{radiance:.2f}, of the picture {shown:.2f}; plan {1e3 * spent:.0f} ms\n"
        )


if __name__ == "__main__":
    names = sys.argv[1:]
    known = ["constant", "sky", "sun"]
    study(names or known) if set(names) <= set(known) else images(*map(Path, names))
