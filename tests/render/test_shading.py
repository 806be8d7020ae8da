"""The estimator of direct light: against quadrature, and what must hold for any light."""

from itertools import accumulate

import numpy as np
import pytest
import torch
import trimesh

from bench.timing import peak_bytes
from reli3d.geometry.rays import RayScene
from reli3d.render.environment import Environment
from reli3d.render.material import DIFFUSE_MODELS
from reli3d.render.points import SurfacePoints
from reli3d.render.shading import ShadeOptions, shade
from tests.support import reference
from tests.support.meshes import mesh_from
from tests.support.scenes import shadow_caster, sky
from tests.support.surfaces import at, lit, on_ball, points


def repeat(count, *rows):
    return [r.expand(count, *r.shape[1:]).contiguous() for r in rows]


@pytest.mark.parametrize("diffuse_model", DIFFUSE_MODELS)
@pytest.mark.parametrize("cos_o", [1.0, 0.5, 0.1])
def test_lambert_under_constant_light_is_its_closed_form(device, diffuse_model, cos_o):
    """With base 0 only the coat is left, so the difference to base kd is the diffuse part, per channel kd c times the
    mean of: of roughness 1, where the cosine that counts is (1 + cos) / 2, (1 - F(c_o)) (1 - F(c_i)); published,
    1 - F(wo.wm)."""
    n = 8000
    up, view = torch.tensor([[0.0, 1.0, 0.0]]), torch.tensor([[(1 - cos_o**2) ** 0.5, cos_o, 0.0]])
    kd, c = torch.tensor([0.8, 0.5, 0.2]), torch.tensor([2.0, 0.7, 1.3])
    normal, wo, base, one, zero = (v.to(device) for v in repeat(n, up, view, kd[None], torch.ones(1), torch.zeros(1)))
    env = Environment.constant(c.to(device))
    black, white = (
        lit(on_ball(normal, wo, b, one, zero), env, diffuse_model=diffuse_model) for b in (torch.zeros_like(base), base)
    )
    got = (white - black).double().cpu()
    d, angle = reference.sphere_grid(512)
    d = d[d[:, 1] > 0]
    schlick = lambda cos: 0.04 + 0.96 * (1 - cos) ** 5
    left = (1 - schlick((1 + d[:, 1]) / 2)) * (1 - schlick((1 + cos_o) / 2))
    if diffuse_model == "published":
        left = 1 - schlick((d + view.double()).norm(dim=-1) / 2)
    exact = kd * c * float((left * d[:, 1]).sum() * angle / torch.pi)
    error = got.std(0) / n**0.5
    assert bool(((got.mean(0) - exact).abs() < 4 * error + 2e-6 * exact).all())  # 2e-6: float32, and the midpoint rule
    assert bool((error < 1e-3 * exact).all())


def test_embree_and_warp_cast_the_same_shadows_in_values_and_gradients():
    wo, inputs = gradient_inputs(torch.device("cpu"), n=3000)
    weight = torch.rand(3000, 3, generator=torch.Generator().manual_seed(2))
    results = []
    for scene in (shadow_caster("cpu", "embree"), shadow_caster("cpu", "warp"), None):
        still = inputs[0].detach()
        got = lit(at(still * 0.5, inputs[0], still, wo, *inputs[1:4]), Environment(inputs[4]), scene=scene)
        results.append([got.detach(), *torch.autograd.grad((got * weight).sum(), inputs)])
    a, b, free = results
    changed = ((a[0] - b[0]).abs() > 1e-5).any(-1).float().mean()
    assert changed < 2e-3  # 64 rays a point: a silhouette ray differs with probability of about 1e-5
    for one, other, unshadowed in zip(a, b, free, strict=True):  # normal, base color, roughness, metallic, texels
        # those points; where no ray differs all are equal bit for bit
        assert reference.fraction_within(one, other) >= 0.998
        assert reference.fraction_within(one, unshadowed) < 0.9  # the shadow is there


@pytest.mark.parametrize("shadows", [False, True])
@pytest.mark.parametrize("counts", [(1, 0, 0), (0, 1, 0), (0, 0, 1)])
def test_a_single_sample_is_cut_at_the_clamp(device, counts, shadows):
    """With one sample of one strategy the clamp is the least of the value and it, and the mean over many seeds too."""
    wo, inputs = gradient_inputs(device, n=2000)
    normal, *values = (v.detach() for v in inputs)
    scene = shadow_caster(device) if shadows else None
    args, light = at(normal * 0.5, normal, normal, wo, *values[:3]), Environment(values[3])
    for seed in range(8):
        options = {"samples": counts, "seed": seed, "sequence": "random"}
        free = lit(args, light, scene=scene, **options)
        clamp = float(free[free > 0].median())
        assert torch.equal(lit(args, light, scene=scene, clamp=clamp, **options), free.clamp(max=clamp))
        assert torch.equal(lit(args, light, scene=scene, clamp=1e30, **options), free)
        # of four samples each is cut at a quarter: none adds up to more, and what stays below a quarter is whole
        options["samples"] = tuple(4 * k for k in counts)
        whole, cut = (lit(args, light, scene=scene, clamp=c, **options) for c in (None, clamp))
        assert float(cut.max()) <= clamp * (1 + 1e-6) and bool((cut <= whole).all())
        low = whole <= clamp / 4
        assert torch.equal(cut[low], whole[low]) and 0.01 < float((cut < whole).float().mean()) < 0.99


def test_bad_input_is_named(device):
    assert ShadeOptions(seed=np.int64(3)).seed == 3
    normal, wo = (v.to(device) for v in points(4))
    one, env = torch.ones(4, device=device), Environment(sky().radiance.to(device))
    surface = dict(position=normal, normal=normal, ng=normal, base_color=normal.abs(), roughness=one, metallic=one)
    call = dict(wo=wo, environment=env)
    for change, kind, name in [
        ({"normal": normal.double()}, TypeError, "normal"),
        ({"roughness": one[:3]}, ValueError, "roughness"),
        ({"samples": (1, 2)}, ValueError, "samples"),
        ({"samples": (-1, 2, 3)}, ValueError, "samples"),
        ({"heuristic": "x"}, ValueError, "heuristic"),
        ({"clamp": 0.0}, ValueError, "clamp"),
        ({"diffuse_model": "white"}, ValueError, "diffuse_model"),
        ({"antithetic": True}, ValueError, "antithetic"),
        ({"pixels": torch.arange(3, dtype=torch.int32, device=device)}, ValueError, "pixels"),
        ({"environment": env.radiance}, TypeError, "environment"),
        ({"options": {"seed": 1}}, TypeError, "options"),
        ({"points": (normal, wo)}, TypeError, "points"),
        ({"sequence": "sobol"}, ValueError, "sequence"),
        ({"alpha": "cubed"}, ValueError, "alpha"),
        ({"seed": 1.5}, TypeError, "seed"),
        ({"wo": wo[:2]}, ValueError, "wo"),
        ({"normal": 0.5}, TypeError, "normal"),
    ]:
        with pytest.raises(kind, match=f"{name}: expected"):
            own = {k: change.get(k, v) for k, v in surface.items()}
            given = {k: v for k, v in change.items() if k in ("points", "pixels", "wo", "environment", "options")}
            options = {k: v for k, v in change.items() if k not in own and k not in given}
            shade(**{"points": SurfacePoints(**own), "options": ShadeOptions(**options), **call, **given})


def test_lighting_in_a_frame_of_its_own_is_that_of_turned_points_and_occluders(device):
    """Turning the surface, the occluders and the eye leaves an environment and the samples as they are."""
    count = 2000
    _, inputs = gradient_inputs(device, n=count)
    normal, *rest, radiance = inputs
    still = torch.tensor([0.0, 1.0, 0.0], device=device).expand(count, 3)
    wo = torch.nn.functional.normalize(still + 0.5 * normal.detach(), dim=-1)
    place = normal.detach() * torch.tensor([1.0, 0.0, 1.0], device=device)  # on a floor, under a ball
    ball = shadow_caster(device)
    floor = torch.tensor([[-2.0, 0, -2], [-2, 0, 2], [2, 0, 2], [2, 0, -2]], device=device)
    vertices = torch.cat([ball.vertices, floor])
    corners = torch.tensor([[0, 1, 2], [0, 2, 3]], dtype=torch.int32, device=device)
    faces = torch.cat([ball.faces, corners + len(ball.vertices)])
    axis = torch.tensor([0.6, -0.2, 0.5], device=device)
    skew = torch.linalg.cross(axis.expand(3, 3), torch.eye(3, device=device))
    turns = torch.linalg.matrix_exp(torch.stack([skew, -1.5 * skew, 0.0 * skew]))  # the environments' of every third
    weight = torch.rand(count, 3, generator=torch.Generator().manual_seed(2)).to(device)
    tilted = torch.nn.functional.normalize(still + 0.3 * normal, dim=-1)
    which, results = torch.arange(count, device=device) % 3, []
    points, eye = at(place, tilted, still, wo, *rest)
    pixels = torch.arange(count, dtype=torch.int32, device=device)
    scene, light = RayScene(vertices, faces), Environment(radiance)
    together = shade(points, eye, light, scene=scene, rotations=turns[which])
    separate = torch.zeros_like(together)
    for k, turn in enumerate(turns):
        rows = which == k
        given = at(*(v[rows] @ turn for v in (place, tilted, still, wo)), *(v[rows] for v in rest))
        scene_k = RayScene(vertices @ turn, faces)
        separate = separate.index_put((rows,), shade(*given, light, scene=scene_k, pixels=pixels[rows]))
    ignored = shade(points, eye, light, scene=scene)
    for got in (together, separate, ignored):
        results.append([got.detach(), *torch.autograd.grad((got * weight).sum(), inputs, retain_graph=True)])
    for got, expected, other in zip(*results, strict=True):
        bound = 1e-3 * float(expected.abs().mean())  # rounding of directions; a few shadow rays pass edges differently
        assert float((got - expected).abs().mean()) < bound < 0.1 * float((got - other).abs().mean())


def gradient_inputs(device, n=400):
    normal, wo = points(n, seed=4)
    g = torch.Generator().manual_seed(9)
    base, rough = 0.1 + 0.8 * torch.rand(n, 3, generator=g), 0.3 + 0.6 * torch.rand(n, generator=g)
    values = (normal, base, rough, torch.rand(n, generator=g), sky(8).radiance)
    return wo.to(device), [v.to(device).requires_grad_() for v in values]


def test_gradient_is_that_of_the_clamped_estimator_where_the_samples_stand_still(device):
    """With environment samples alone nothing drawn depends on the material, so finite differences see the same
    samples, and the same ones are cut by a clamp that half of them reach."""
    wo, inputs = gradient_inputs(device)
    weight = torch.rand(len(wo), 3, generator=torch.Generator().manual_seed(2)).to(device)

    def loss(normal, base, roughness, metallic, radiance):
        env = Environment(radiance)
        object.__setattr__(env, "cdf", cdf)  # the light's own change must not move the samples either
        out = lit(on_ball(normal, wo, base, roughness, metallic), env, samples=(48, 0, 0), clamp=clamp)
        return (out * weight).double().sum()

    normal, *rest = (v.detach() for v in inputs)
    light = Environment(rest[3])
    cdf, single = light.cdf, lit(on_ball(normal, wo, *rest[:3]), light, samples=(1, 0, 0))
    clamp = float(single[single > 0].median())
    grads = torch.autograd.grad(loss(*inputs), inputs)
    generator = torch.Generator().manual_seed(3)
    for k, (value, grad) in enumerate(zip(inputs, grads, strict=True)):
        direction = torch.randn(value.shape, generator=generator).to(device)
        if k == 0:  # stay on the sphere, where the shading is defined
            direction = direction - (direction * value).sum(-1, keepdim=True) * value
        eps = 1e-4  # over 1e-3 one sample in a thousand comes to the clamp or leaves it
        shifted = []
        for sign in (1, -1):
            moved = [v.detach() for v in inputs]
            moved[k] = value.detach() + sign * eps * direction
            if k == 0:
                moved[k] = torch.nn.functional.normalize(moved[k], dim=-1)
            shifted.append(loss(*moved))
        gradient = (shifted[0] - shifted[1]) / (2 * eps)
        got = (grad.double() * direction).sum()
        scale = (grad.double() * direction).abs().sum()
        # central difference of float32 sums: 1e-7 of the loss over eps, and eps^2 of the curvature
        assert abs(got - gradient) < 2e-3 * scale, (k, got, gradient, scale)


# counts, roughness, metallic, options; visible normals alone reach the diffuse part with rare, heavy samples
MEANS = [
    ((20, 40, 4), 0.6, 0.4, {}),
    ((0, 0, 64), 0.9, 0.0, {}),
    ((0, 64, 0), 0.6, 1.0, {}),
    ((0, 63, 0), 0.45, 1.0, {}),
    ((64, 0, 0), 0.45, 0.3, {}),
    ((20, 40, 4), 0.6, 0.4, {"diffuse_model": "published"}),
    ((20, 40, 4), 0.9, 0.0, {"heuristic": "power"}),
    ((20, 40, 4), 0.6, 0.4, {"sequence": "random"}),
    ((20, 40, 4), 0.45, 0.3, {"antithetic": "none"}),
    ((20, 7, 0), 0.6, 0.4, {"antithetic": "mirrored"}),
    ((20, 7, 0), 0.6, 0.4, {"heuristic": "power", "sequence": "random", "antithetic": "none"}),
]


@pytest.mark.parametrize("counts, roughness, metallic, options", MEANS)
def test_means_of_value_and_gradient_are_those_of_the_integral(device, counts, roughness, metallic, options):
    """However the samples are drawn and weighted: quadrature knows neither."""
    normal, wo = points(3, seed=11)
    n, env = 6000, sky(8)
    probes = torch.randn(8, 8, 16, 3, generator=torch.Generator().manual_seed(12))  # directions in the space of maps
    for k in range(2):
        inputs = [normal[k].double(), torch.tensor([0.7, 0.4, 0.2]).double(), torch.tensor(roughness).double(),
                    torch.tensor(metallic).double(), env.radiance.double()]  # fmt: skip
        inputs = [v.requires_grad_() for v in inputs]
        value = reference.direct_light(
            inputs[0] / inputs[0].norm(), wo[k].double(), inputs[1], inputs[2] ** 2, inputs[3], inputs[4],
            192, options.get("diffuse_model", "conserving"),
        )  # fmt: skip
        exact = torch.autograd.grad(value.sum(), inputs)
        one = normal[k : k + 1], *(v.detach().float()[None] for v in inputs[1:4])
        rows = repeat(n, *one)
        rows = [r.to(device).requires_grad_() for r in rows]
        light = env.radiance.to(device).requires_grad_()
        view = wo[k : k + 1].expand(n, 3).contiguous().to(device)
        map_ = Environment(light)
        got = lit(on_ball(rows[0], view, *rows[1:]), map_, samples=counts, **options)
        error = got.detach().std(0) / n**0.5 + 5e-4 * value.detach().float().to(device)  # 192 rows of quadrature
        assert ((got.detach().mean(0) - value.detach().to(device)) / error).abs().max() < 4.5
        grads = torch.autograd.grad(got.sum(), rows)
        tangent = grads[0] - (grads[0] * rows[0]).sum(-1, keepdim=True) * rows[0]
        for g, t in zip([tangent, *grads[1:]], exact[:4], strict=True):
            error = g.std(0) / n**0.5 + 1e-3 * t.abs().max().float().to(device)  # second term: the quadrature's
            assert ((g.mean(0) - t.to(device)) / error).abs().max() < 4.5
        fixed, gradients = [r[:100].detach() for r in rows], []
        for seed in range(60):  # means of 100 rows, for the error of a map's gradient
            part = lit(on_ball(fixed[0], view[:100], *fixed[1:]), map_, samples=counts, seed=seed, **options)
            gradients.append(torch.autograd.grad(part.sum() / 100, light)[0].cpu().double())
        gradients = torch.einsum("bhwc,phwc->bp", torch.stack(gradients), probes.double())
        expected = torch.einsum("hwc,phwc->p", exact[4], probes.double())
        error = gradients.std(0) / 60**0.5 + 5e-4 * exact[4].norm()  # second term: the quadrature's
        z = ((gradients.mean(0) - expected) / error).abs().max()
        assert z < 4.5  # t of 59 degrees: 3e-5 a number, 176 in the family


def most_held(step, device) -> int:
    """Most bytes that torch's allocators hold for ``step`` at a time, counted one by one: the same in every run."""
    if device.type == "cuda":
        return peak_bytes(step, device)
    with torch.autograd.profiler.profile(profile_memory=True) as profile:
        step()
    changes = [e for e in profile.kineto_results.events() if e.name() == "[memory]"]
    changes.sort(key=lambda e: e.start_ns())
    return max(accumulate(e.nbytes() for e in changes))


@pytest.mark.parametrize("shadows", [False, True])
def test_memory_does_not_grow_with_samples(device, shadows):
    """Forward and backward of 2048 points: 1024 samples each need 30 words of visibility more than 64.  An array of two
    million of anything, a byte each at least, would be 100 times the slack."""
    wo, inputs = gradient_inputs(device, n=2048)
    scene, environment = None, Environment(inputs[4])
    if shadows:
        scene = RayScene(mesh_from(trimesh.creation.icosphere(subdivisions=2, radius=0.5), device))

    def most(samples):
        def step():
            out = lit(on_ball(inputs[0], wo, *inputs[1:4]), environment, scene=scene, samples=samples)
            torch.autograd.grad(out.sum(), inputs)

        step()  # creates cached values
        return most_held(step, device)

    threads, words = torch.get_num_threads(), 2048 * (1024 - 64) // 32 * 4
    torch.set_num_threads(1)  # all in this thread, which the profiler watches; two would not always hold theirs at once
    try:
        few, many = most((20, 40, 4)), most((320, 640, 64))
    finally:
        torch.set_num_threads(threads)
    assert words // 2 < many - few < words + 20_000  # measured: the words, and 5 kB for more Halton points
