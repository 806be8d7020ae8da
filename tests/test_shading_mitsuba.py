"""Images and gradients of the estimator against Mitsuba 3: same mesh, rays, formula and map, all else its own."""

import numpy as np
import pytest
import torch
import trimesh
from scipy.special import erfc

from reli3d.geometry.rays import RayScene
from reli3d.render.camera import Camera, camera_rays, look_at
from reli3d.render.environment import Environment
from reli3d.render.gbuffer import hit_normals, interpolate
from reli3d.render.shading import SAMPLES, shade
from tests import mitsuba_scene

pytestmark = pytest.mark.slow  # Mitsuba compiles its kernels for half a minute a case

BASE = (0.8, 0.4, 0.1)
MATERIALS = {"diffuse": (0.64, 0.0), "glossy": (0.04, 0.0), "metal": (0.09, 1.0)}  # GGX width, metallic


def light(name):
    map_ = torch.rand(16, 32, 3, generator=torch.Generator().manual_seed(3)) ** 3 * 2.0
    if name == "constant":
        map_ = torch.full((16, 32, 3), 0.7)
    if name == "sun":
        map_[4, 20] = 400.0
    return Environment(map_)


def ball_in_ring():
    ball = trimesh.creation.icosphere(subdivisions=3, radius=0.5)
    ring = trimesh.creation.torus(0.75, 0.15, major_sections=40, minor_sections=16)
    return trimesh.util.concatenate([ball, ring])


class Stage:
    """A mesh that shadows itself, and the primary hits of one camera that both sides share."""

    def __init__(self, size, mesh=None):
        mesh = ball_in_ring() if mesh is None else mesh
        self.vertices, self.faces = torch.tensor(mesh.vertices).float(), torch.tensor(mesh.faces).int()
        self.normals = torch.tensor(np.array(mesh.vertex_normals)).float()
        pose = look_at(torch.tensor([1.2, 1.6, 1.9]), torch.zeros(3), torch.tensor([0.0, 1, 0]))
        camera = Camera.from_fov(pose, 0.6, size, size)
        origins, directions = (v.reshape(-1, 3).contiguous() for v in camera_rays(camera))
        self.scene = RayScene(self.vertices, self.faces)
        hits = self.scene.closest(origins, directions)
        normal = interpolate(self.normals, self.faces, hits.face, hits.bary)
        normal = torch.nn.functional.normalize(normal, dim=-1)
        # Mitsuba bends no normals
        index = torch.nonzero((hits.face >= 0) & ((normal * -directions).sum(-1) > 0.05))[:, 0]
        self.origins, self.directions, self.normal = origins[index], directions[index], normal[index]
        self.position = interpolate(self.vertices, self.faces, hits.face[index], hits.bary[index])
        self.ng = hit_normals(self.vertices, self.faces, hits.face[index])

    def world(self, mi, environment, bsdf):
        mesh = mitsuba_scene.smooth_mesh(mi, self.vertices, self.faces, self.normals, bsdf)
        return mi.load_dict(
            {"type": "scene", "light": mitsuba_scene.environment(mi, environment.radiance), "mesh": mesh}
        )

    def shade(self, base, roughness, metallic, environment, seed):
        n = len(self.position)
        return shade(self.position, self.normal, self.ng, -self.directions, base.expand(n, 3), roughness.expand(n),
                     torch.full((n,), metallic), environment, scene=self.scene, seed=seed)  # fmt: skip


@pytest.mark.parametrize("material", MATERIALS)
@pytest.mark.parametrize("sky", ["constant", "sky", "sun"])
def test_image_with_shadows_equals_mitsubas(material, sky):
    compare_image(material, sky, Stage(48))


@pytest.mark.parametrize("material", MATERIALS)
def test_image_of_a_cow_equals_mitsubas(material, shared_data):
    cow = trimesh.load(shared_data / "classic" / "spot" / "spot.obj", process=False)
    cow = trimesh.Trimesh(cow.vertices, cow.faces)  # without uv: vertices of the same place become one
    cow.apply_translation(-cow.bounds.mean(0))
    compare_image(material, "sky", Stage(48, cow))


BUDGET = 2_000_000  # light samples of our image; Mitsuba's own image tests spend as many
FLOOR = 1e-4  # of the variance of a sample, as there
ACCEPT, LEVEL = 0.9975, 0.01


def rejected(got, want, variance, samples):
    """Pixels and channels that a z-test at ``LEVEL`` over all of them (Sidak) tells from the reference.

    ``variance``: of one sample of the reference; ``samples``: how many ``got`` is the mean of.
    """
    z = np.abs(got - want) * np.sqrt(samples / np.maximum(variance, FLOOR))
    return erfc(z / 2**0.5) < 1.0 - (1.0 - LEVEL) ** (1.0 / z.size)  # erfc(z / sqrt 2) = 2 (1 - Phi(z))


def compare_image(material, sky, stage):
    """The z-test of Mitsuba's ``test_renders.py``, against eight times as many samples of Mitsuba's; and the mean."""
    mi = mitsuba_scene.load()
    (alpha, metallic), environment = MATERIALS[material], light(sky)
    world = stage.world(mi, environment, mitsuba_scene.material(mi, BASE, alpha, metallic))
    pixels = len(stage.position)
    count = -(-BUDGET // (pixels * sum(SAMPLES)))
    draws, passes = 64, count * 4  # a sample of its path draws one direction by the light and one by the material
    want, variance = mitsuba_scene.radiance(mi, world, stage.origins, stage.directions, draws, passes)
    variance = 2.0 * variance  # of one drawn direction
    base, rough = torch.tensor(BASE), torch.tensor(alpha**0.5)
    runs = torch.stack([stage.shade(base, rough, metallic, environment, k) for k in range(count)]).double().numpy()
    got, spp = runs.mean(0), count * sum(SAMPLES)
    assert 1.0 - rejected(got, want, variance, spp).mean() >= ACCEPT
    own = runs.mean((1, 2)).var(ddof=1) / count
    sigma = np.sqrt(own + variance.sum() / (2 * draws * passes) / got.size**2)
    assert abs(got.mean() - want.mean()) < 3.0 * sigma
    assert sigma < 0.005 * want.mean()  # so that the mean tells 1.5 % from none; measured 0.03 to 0.25 %


@pytest.mark.parametrize("material", MATERIALS)
def test_gradients_with_shadows_equal_mitsubas(material):
    """Base colour, GGX width and texels: means of 24 runs against means of 24 of Mitsuba's reverse mode."""
    import math

    mi = mitsuba_scene.load()
    import drjit as dr

    (alpha, metallic), environment, stage, runs = MATERIALS[material], light("sky"), Stage(32), 24
    g = torch.Generator().manual_seed(8)
    weight = torch.rand(len(stage.position), 3, generator=g)
    probes = torch.randn(6, *environment.radiance.shape, generator=g)  # directions in the space of maps
    probes[0] = 1.0
    base, width = mi.Color3f(*BASE), mi.Float(alpha)
    dr.enable_grad(base, width)
    world = stage.world(mi, environment, mitsuba_scene.material(mi, base, width, metallic))
    params = mi.traverse(world)
    nodes = mi.TensorXf(params["light.data"])
    integrator = mi.load_dict({"type": "direct", "emitter_samples": 32, "bsdf_samples": 32, "hide_emitters": True})
    ray = mi.RayDifferential3f(mi.Point3f(stage.origins.numpy().T), mi.Vector3f(stage.directions.numpy().T))
    want = []
    for k in range(runs):
        dr.enable_grad(nodes)
        params["light.data"] = nodes
        params.update()
        for v in (base, width, nodes):
            dr.set_grad(v, 0.0)
        sampler = mi.load_dict({"type": "independent"})
        sampler.seed(k + 1, len(weight))
        color = integrator.sample(world, sampler, ray)[0]
        dr.backward(dr.sum(dr.sum(color * mi.Color3f(weight.numpy().T))))
        slopes = torch.from_numpy(np.array(dr.grad(nodes)))
        folded = slopes[:, 1:-1].clone()  # a column of the other end is repeated on either side
        folded[:, -1] += slopes[:, 0]
        folded[:, 0] += slopes[:, -1]
        leaf = environment.radiance.clone().requires_grad_()
        (texels,) = torch.autograd.grad(mitsuba_scene.node_rows(leaf), leaf, folded)
        row = [*np.array(dr.grad(base)).ravel(), float(np.array(dr.grad(width))[0])]
        want.append(row + [float((texels * p).sum()) for p in probes])
    got = []
    for k in range(runs):
        paint, rough = torch.tensor(BASE).requires_grad_(), torch.tensor(math.sqrt(alpha)).requires_grad_()
        map_ = environment.radiance.clone().requires_grad_()
        out = stage.shade(paint, rough, metallic, Environment(map_), k)
        grads = torch.autograd.grad((out * weight).sum(), (paint, rough, map_))
        to_alpha = float(grads[1]) / (2.0 * math.sqrt(alpha))
        got.append([*grads[0].tolist(), to_alpha, *((grads[2] * p).sum().item() for p in probes)])
    got, want = np.array(got), np.array(want)
    error = np.sqrt((got.var(0, ddof=1) + want.var(0, ddof=1)) / runs) + 2e-4 * np.abs(want.mean(0))
    # second term: shadow edges of float32 geometry, and the half floats of Mitsuba's map
    z = (got.mean(0) - want.mean(0)) / error
    assert np.abs(z).max() < 4.0, (z, got.mean(0), want.mean(0))  # 30 numbers in the family, t with 40 degrees
    assert (np.abs(want.mean(0)) > 5 * error)[:5].all()  # the noise is far below what is compared
