"""Images and gradients of the estimator against Mitsuba 3: same mesh, rays, formula and map, all else its own."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch
import trimesh
from scipy.special import erfc

from bench.peers import mitsuba_material
from reli3d.geometry.camera import Camera, camera_rays, look_at
from reli3d.geometry.hits import hit_normals, interpolate
from reli3d.geometry.mesh import Mesh
from reli3d.geometry.rays import RayScene
from reli3d.render.asset import Asset, TextureSet
from reli3d.render.color import srgb_to_linear
from reli3d.render.environment import Environment
from reli3d.render.image import render_asset
from reli3d.render.latlong import quarter_turn
from reli3d.render.shading import Samples, ShadeOptions
from tests.support import mitsuba_scene
from tests.support.surfaces import at, lit

pytestmark = pytest.mark.slow  # Mitsuba compiles its kernels for half a minute a case

BASE = (0.8, 0.4, 0.1)
MATERIALS = {"diffuse": (0.64, 0.0), "glossy": (0.04, 0.0), "metal": (0.09, 1.0)}  # GGX width, metallic


def light(name):
    map_ = torch.rand(16, 32, 3, generator=torch.Generator().manual_seed(3)) ** 3 * 2.0
    if name == "constant":
        map_ = torch.full((16, 32, 3), 0.7)
    if name == "sun":
        map_[4, 20] = 400.0
    # The z-test takes Mitsuba's variance.  Without the quarter turn, the sun lights most of the scene, and ours is 2.6
    # (diffuse) and 2.9 times (glossy) as large: our sampling density is constant over each texel, Mitsuba's bilinear.
    return Environment(quarter_turn(map_, -1).contiguous())


def ball_in_ring():
    ball = trimesh.creation.icosphere(subdivisions=3, radius=0.5)
    ring = trimesh.creation.torus(0.75, 0.15, major_sections=40, minor_sections=16)
    return trimesh.util.concatenate([ball, ring])


class Stage:
    """A mesh that shadows itself, and the primary hits of one camera, for both renderers."""

    def __init__(self, size, mesh=None, device="cpu", backend="auto"):
        """backend: of our shadows; on ``device``, where only ``shade`` computes."""
        mesh = ball_in_ring() if mesh is None else mesh
        self.vertices, self.faces = torch.tensor(mesh.vertices).float(), torch.tensor(mesh.faces).int()
        self.normals = torch.tensor(np.array(mesh.vertex_normals)).float()
        pose = look_at(torch.tensor([1.2, 1.6, 1.9]), torch.zeros(3), torch.tensor([0.0, 1, 0]))
        camera = Camera.from_fov(pose, 0.6, size, size)
        origins, directions = (v.reshape(-1, 3).contiguous() for v in camera_rays(camera))
        self.device, self.scene = device, RayScene(self.vertices.to(device), self.faces.to(device), backend=backend)
        hits = RayScene(self.vertices, self.faces).closest(origins, directions)
        normal = interpolate(self.normals, self.faces, hits.face, hits.bary)
        normal = torch.nn.functional.normalize(normal, dim=-1)
        # Mitsuba adjusts no normals
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
        material = base.expand(n, 3), roughness.expand(n), torch.full((n,), metallic)
        values = self.position, self.normal, self.ng, -self.directions, *material
        light = Environment(environment.radiance.to(self.device))
        return lit(at(*(v.to(self.device) for v in values)), light, scene=self.scene, seed=seed).cpu()


@pytest.mark.parametrize("material", MATERIALS)
@pytest.mark.parametrize("sky", ["constant", "sky", "sun"])
def test_image_with_shadows_equals_mitsubas(device, material, sky):
    compare_image(material, sky, Stage(48, device=device))


@pytest.mark.parametrize("material, sky", [("diffuse", "sun"), ("glossy", "sky")])
def test_image_with_warps_shadows_equals_mitsubas(device, material, sky):
    """The fused kernel, which traces shadow rays itself; Embree traces them between two kernels."""
    compare_image(material, sky, Stage(48, device=device, backend="warp"))


@pytest.mark.parametrize("material", MATERIALS)
def test_image_of_a_cow_equals_mitsubas(device, material, shared_data):
    cow = trimesh.load(shared_data / "classic" / "spot" / "spot.obj", process=False)
    cow = trimesh.Trimesh(cow.vertices, cow.faces)  # without uv: vertices of the same place become one
    cow.apply_translation(-cow.bounds.mean(0))
    compare_image(material, "sky", Stage(48, cow, device))


BUDGET = 2_000_000  # light samples of our image; Mitsuba's own image tests spend as many
FLOOR = 1e-4  # of the variance of a sample, as there
ACCEPT, SIGNIFICANCE = 0.9975, 0.01


def rejected(got, expected, variance, samples):
    """Pixels and channels that a z-test at ``SIGNIFICANCE`` over all of them (Sidak) distinguishes from the reference.

    ``variance``: of one sample of the reference; ``samples``: how many ``got`` is the mean of.
    """
    z = np.abs(got - expected) * np.sqrt(samples / np.maximum(variance, FLOOR))
    return erfc(z / 2**0.5) < 1.0 - (1.0 - SIGNIFICANCE) ** (1.0 / z.size)  # erfc(z / sqrt 2) = 2 (1 - Phi(z))


def compare_image(material, sky, stage):
    """The z-test of Mitsuba's ``test_renders.py``, against at least eight times as many samples of Mitsuba's."""
    mi = mitsuba_scene.load()
    (alpha, metallic), environment = MATERIALS[material], light(sky)
    world = stage.world(mi, environment, mitsuba_material.material(mi, BASE, alpha, metallic))
    count = runs_for(len(stage.position))
    draws, passes = 64, count * (16 if sky == "sun" else 4)  # its own noise counts where few samples find the sun
    expected, variance = mitsuba_scene.radiance(mi, world, stage.origins, stage.directions, draws, passes)
    base, rough = torch.tensor(BASE), torch.tensor(alpha**0.5)
    runs = torch.stack([stage.shade(base, rough, metallic, environment, k) for k in range(count)]).double().numpy()
    compare(runs, expected, 2.0 * variance, 2 * draws * passes)


def runs_for(rays):
    """How often ``rays`` points are shaded to spend the budget."""
    return -(-BUDGET // (rays * sum(Samples())))


def compare(runs, expected, variance, theirs):
    """The z-test of pixels ``(P, 3)``; one of all of them with the noise of both sides; and one of their mean.  In the
    last two an error of 2 % must show: of every pixel, and up and down in turn, so that the mean stays.

    runs: ``(K, P, 3)``.  variance: of one drawn direction of the reference, which is the mean of ``theirs``; a sample
    of Mitsuba's path draws two, one by the light and one by the material.
    """
    got = runs.mean(0)
    assert 1.0 - rejected(got, expected, variance, len(runs) * sum(Samples())).mean() >= ACCEPT
    own = runs.mean((1, 2)).var(ddof=1) / len(runs)
    sigma = np.sqrt(own + variance.sum() / theirs / got.size**2)
    stripes = 1.0 + 0.02 * np.where(np.arange(len(got)) % 2, 1.0, -1.0)[:, None]
    error = np.sqrt(runs.var(0, ddof=1) / len(runs) + variance / theirs)
    square = lambda v: (((v - expected) / error) ** 2).mean() * (len(runs) - 3) / (len(runs) - 1)
    # the square of Student's t with K - 1 degrees is (K - 1) / (K - 3) in the mean; measured 0.93 to 1.04, stripes 1.24
    assert square(got) < 1.15 < square(got * stripes)
    assert abs(got.mean() - expected.mean()) < 3.0 * sigma
    assert sigma < 0.005 * expected.mean()  # so that the mean distinguishes 1.5 % from none; measured 0.03 to 0.25 %
    assert min(abs(k * got.mean() - expected.mean()) for k in (0.98, 1.02)) > 3.0 * sigma


def mapped_ball_in_ring():
    """With maps of 8 texels a side that differ in every channel; they are mapped to x and -y."""
    mesh = ball_in_ring()
    vertices, faces = torch.tensor(mesh.vertices).float(), torch.tensor(mesh.faces).int()
    normals = torch.tensor(np.array(mesh.vertex_normals)).float()
    uv = vertices[:, :2] * torch.tensor([0.5, -0.5]) + 0.5
    g = torch.Generator().manual_seed(12)
    base, orm = 0.1 + 0.8 * torch.rand(8, 8, 3, generator=g), torch.rand(8, 8, 3, generator=g)
    orm[..., 1] = 0.3 + 0.7 * orm[..., 1]
    return Asset(Mesh(vertices, faces, normals, uv), TextureSet(base, orm[..., 1], orm[..., 2]))


def test_render_equals_mitsubas_sensor_textures_and_light(device):
    """All of ``render``: camera, rows of the image, subpixels, hits, maps, shadows; seen by Mitsuba's own
    ``perspective``, whose rays through the same subpixels give the reference, and whose film the coverage."""
    mi = mitsuba_scene.load()
    asset, environment, (width, height, fine, fov) = mapped_ball_in_ring(), light("sky"), (40, 32, 2, 0.75)
    eye, target = (1.2, 1.6, 1.9), (0.1, -0.1, 0.05)
    bsdf, m = mitsuba_material.material(mi, BASE, 0.0, 0.0, maps=asset.textures), asset.mesh
    mesh = mitsuba_scene.smooth_mesh(mi, m.vertices, m.faces, m.normals, bsdf, m.uv)
    world = mi.load_dict({"type": "scene", "light": mitsuba_scene.environment(mi, environment.radiance), "mesh": mesh})
    sensor = mitsuba_scene.sensor(mi, eye, target, fov, fine * width, fine * height)
    origins, directions = mitsuba_scene.rays_through_pixel_centers(mi, sensor)
    si = world.ray_intersect(mi.Ray3f(*(mi.Vector3f(v.numpy().T) for v in (origins, directions))))
    hit, cos = np.array(si.is_valid()), np.array(si.wi.z)
    count = runs_for(hit.sum())
    draws, passes = 64, 4 * count
    values = np.zeros((2, len(hit), 3))
    index = np.nonzero(hit)[0]
    values[:, index] = mitsuba_scene.radiance(mi, world, origins[index], directions[index], draws, passes)

    def pixels(v):
        """The subpixels of every pixel: ``(height, width, fine^2, C)``."""
        return v.reshape(height, fine, width, fine, -1).swapaxes(1, 2).reshape(height, width, fine**2, -1)

    adjusted = pixels(hit & (cos < 0.05)).any((2, 3))  # Mitsuba adjusts no normals
    kept = pixels(hit).any((2, 3)) & ~adjusted
    assert kept.sum() > 600
    expected, variance = (pixels(v)[kept].mean(1) for v in values)
    variance = 2.0 * variance / fine**2  # as in compare_image; a pixel is the mean of its subpixels

    sky = Environment(environment.radiance.to(device))
    pose = look_at(*(torch.tensor(v, device=device) for v in (eye, target, (0.0, 1.0, 0.0))))
    camera = Camera.from_fov(pose, fov, width, height)
    asset = Asset(
        Mesh(*(getattr(m, k).to(device) for k in ("vertices", "faces", "normals", "uv"))), asset.textures.to(device)
    )

    def runs(asset, camera):
        images = (
            render_asset(asset, camera, sky, supersampling=fine, options=ShadeOptions(seed=k)).radiance
            for k in range(count)
        )
        return np.stack([v.cpu().double().numpy()[kept] for v in images])

    compare(runs(asset, camera), expected, variance, 2 * draws * passes)
    samples = count * sum(Samples())
    aside = replace(camera, intrinsics=camera.intrinsics + torch.tensor([0.0, 0.0, 0.05, 0.0], device=device))
    raw = replace(asset, textures=replace(asset.textures, base_color=srgb_to_linear(asset.textures.base_color)))
    maps = asset.textures
    flipped = (v.flip(0) for v in (maps.base_color, maps.roughness, maps.metallic, maps.normal))
    turned = replace(asset, textures=TextureSet(*flipped))
    for wrong in ((asset, aside), (raw, camera), (turned, camera)):  # errors that the z-test must detect
        # measured 3 to 98 %
        assert rejected(runs(*wrong).mean(0), expected, variance, samples).mean() > 4 * (1.0 - ACCEPT)

    full = partial(render_asset, asset, camera, sky, options=ShadeOptions(samples=(1, 0, 0)), shadows=False)
    off = full(supersampling=fine).alpha.cpu().numpy() - pixels(hit).mean((2, 3))
    assert (off != 0.0).mean() < 2e-3  # rays that graze the outline; measured 0
    film = mitsuba_scene.sensor(mi, eye, target, fov, width, height)
    integrator = mi.load_dict({"type": "direct", "hide_emitters": True})
    cover = np.array(mi.render(world, sensor=film, integrator=integrator, spp=4096))[..., 3]
    off = np.abs(full(supersampling=8).alpha.cpu().numpy() - cover)
    edge = (cover > 0) & (cover < 1)
    # 8 subpixels a side place an edge to 1/16 of a pixel, Mitsuba's noise is 0.008 at most
    assert edge.sum() > 100 and off.max() < 0.1 and off[edge].mean() < 0.02  # measured 0.04, 0.009


@pytest.mark.parametrize("material", MATERIALS)
def test_gradients_with_shadows_equal_mitsubas(device, material):
    """Base color, GGX width and texels: means of 24 runs against means of 24 of Mitsuba's reverse mode."""
    import math

    mi = mitsuba_scene.load()
    import drjit as dr

    (alpha, metallic), environment, stage, runs = MATERIALS[material], light("sky"), Stage(32, device=device), 24
    g = torch.Generator().manual_seed(8)
    weight = torch.rand(len(stage.position), 3, generator=g)
    probes = torch.randn(6, *environment.radiance.shape, generator=g)  # directions in the space of maps
    probes[0] = 1.0
    base, width = mi.Color3f(*BASE), mi.Float(alpha)
    dr.enable_grad(base, width)
    world = stage.world(mi, environment, mitsuba_material.material(mi, base, width, metallic))
    params = mi.traverse(world)
    nodes = mi.TensorXf(params["light.data"])
    integrator = mi.load_dict({"type": "direct", "emitter_samples": 32, "bsdf_samples": 32, "hide_emitters": True})
    ray = mi.RayDifferential3f(mi.Point3f(stage.origins.numpy().T), mi.Vector3f(stage.directions.numpy().T))
    expected = []
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
        gradients = torch.from_numpy(np.array(dr.grad(nodes)))
        folded = gradients[:, 1:-1].clone()  # a column of the other end is repeated on either side
        folded[:, -1] += gradients[:, 0]
        folded[:, 0] += gradients[:, -1]
        leaf = environment.radiance.clone().requires_grad_()
        (texels,) = torch.autograd.grad(mitsuba_scene.node_rows(leaf), leaf, folded)
        row = [*np.array(dr.grad(base)).ravel(), float(np.array(dr.grad(width))[0])]
        expected.append(row + [float((texels * p).sum()) for p in probes])
    got = []
    for k in range(runs):
        base_color, rough = torch.tensor(BASE).requires_grad_(), torch.tensor(math.sqrt(alpha)).requires_grad_()
        map_ = environment.radiance.clone().requires_grad_()
        out = stage.shade(base_color, rough, metallic, Environment(map_), k)
        grads = torch.autograd.grad((out * weight).sum(), (base_color, rough, map_))
        to_alpha = float(grads[1]) / (2.0 * math.sqrt(alpha))
        got.append([*grads[0].tolist(), to_alpha, *((grads[2] * p).sum().item() for p in probes)])
    got, expected = np.array(got), np.array(expected)
    error = np.sqrt((got.var(0, ddof=1) + expected.var(0, ddof=1)) / runs) + 2e-4 * np.abs(expected.mean(0))
    # second term: shadow edges of float32 geometry, and the half floats of Mitsuba's map
    z = (got.mean(0) - expected.mean(0)) / error
    assert np.abs(z).max() < 4.0, (z, got.mean(0), expected.mean(0))  # 30 numbers in the family, t with 40 degrees
    assert (np.abs(expected.mean(0)) > 5 * error)[:5].all()  # the noise is far below the compared values
