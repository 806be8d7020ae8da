"""FlexiCubes: the published order, topology for every sign pattern, convergence, gradients, closed at the box."""

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree

from bench.flexicubes_torch import cube_list, flexicubes
from reli3d.geometry.mesh import face_components, face_normals, report, vertex_normals, volume
from reli3d.geometry.surface import extract_surface, surface_cubes
from reli3d.triplane import sample_triplane
from tests import reference_surface

F = torch.nn.functional


def grid(n, radius=1.0, device="cpu"):
    axis = torch.linspace(-radius, radius, n + 1, device=device)
    return torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), -1)


def sphere(n, radius=0.6, device="cpu"):
    return grid(n, device=device).norm(dim=-1) - radius


def torus(n, device="cpu"):
    p = grid(n, device=device)
    return torch.hypot(torch.hypot(p[..., 0], p[..., 1]) - 0.6, p[..., 2]) - 0.22


def random_weights(shape, seed, device="cpu", spread=0.9):
    """Weights over more than the range of the published activations, and deformations of nearly half a cube."""
    rng = torch.Generator().manual_seed(seed)
    n = (shape[0] - 1) * (shape[1] - 1) * (shape[2] - 1)
    made = dict(
        alpha=1 + spread * (2 * torch.rand(n, 8, generator=rng) - 1),
        beta=1 + spread * (2 * torch.rand(n, 12, generator=rng) - 1),
        gamma=0.01 + torch.rand(n, generator=rng),
        deformation=(torch.rand(*shape, 3, generator=rng) - 0.5) * 0.98 / (torch.tensor(shape) - 1),
    )
    return {name: value.to(device) for name, value in made.items()}


@pytest.mark.parametrize("name", ["sphere", "sphere_w", "smooth_w", "noise_w"])
def test_vertices_and_faces_are_the_published_ones_in_their_order(goldens, device, name):
    data = np.load(goldens / "flexicubes_16.npz")
    raw = torch.from_numpy(data["weights21"]).to(device)
    level = torch.from_numpy(data[f"{name}.level"]).view(17, 17, 17).to(device)
    weights = {}
    if name != "sphere":
        shift = torch.from_numpy(data["deformation"]).view(17, 17, 17, 3).to(device)
        weights = dict(beta=1 + 0.5 * raw[:, :12].tanh(), alpha=1 + 0.5 * raw[:, 12:20].tanh(),
                       gamma=0.25 + 0.5 * raw[:, 20].sigmoid(), deformation=shift.tanh() * (1 - 1e-8) / 32)  # fmt: skip
    got = extract_surface(level, radius=0.5, closed=False, **weights)
    assert np.array_equal(got.faces.cpu().numpy(), data[f"{name}.f"])
    # coordinates up to 0.53 as quotients of a few float32 terms
    np.testing.assert_allclose(got.vertices.cpu().numpy(), data[f"{name}.v"], rtol=0, atol=3e-7)


def mlp(parameters, prefix, x, layers):
    for n in range(layers):
        x = F.linear(x, parameters[f"{prefix}.{2 * n}.weight"], parameters[f"{prefix}.{2 * n}.bias"])
        x = F.silu(x) if n + 1 < layers else x
    return x


def test_mesh_of_the_published_heads(goldens):
    data = np.load(goldens / "object_representation_mesh16.npz")
    heads = np.load(goldens / "object_representation_heads.npz")
    p = {k.removeprefix("param."): torch.from_numpy(heads[k]) for k in heads if k.startswith("param.")}
    features = sample_triplane(torch.from_numpy(data["triplane"]), grid(16).view(1, -1, 3))[0]
    level = 10 - (mlp(p, "net.heads.density", features, 3) - 1).exp().view(17, 17, 17)
    offset = mlp(p, "net.heads.vertex-offset", features, 3).view(17, 17, 17, 3)
    corner = mlp(p, "net.heads.flexicubes-weight", features, 2).view(17, 17, 17, 16)
    eight = [corner[i : i + 16, j : j + 16, k : k + 16] for k in (0, 1) for j in (0, 1) for i in (0, 1)]
    merged = 0.1 * mlp(p, "indices_merging_mlp.heads.flexicubes-weight", torch.cat(eight, -1).view(-1, 128), 3)
    np.testing.assert_allclose(merged[:64].numpy(), data["weight21_first64"], rtol=0, atol=2e-6)
    got = extract_surface(
        level, radius=0.87, closed=False, deformation=offset.tanh() * (1 - 1e-8) / 32,
        beta=1 + 0.5 * merged[:, :12].tanh(), alpha=1 + 0.5 * merged[:, 12:20].tanh(),
        gamma=0.25 + 0.5 * merged[:, 20].sigmoid())  # fmt: skip
    assert np.array_equal(got.faces.numpy(), data["faces"])
    # density is exp of a sum of 64 products: 1e-5 relative, over slopes of about 1 a cell of 0.1
    np.testing.assert_allclose(got.vertices.numpy(), data["v_pos"], rtol=0, atol=1e-5)
    difference = (vertex_normals(got.vertices, got.faces) - torch.from_numpy(data["v_nrm"])).abs()
    assert difference.quantile(0.999) < 1e-3  # slivers turn with the last digits of their corners


def sign_pattern(case):
    """Level of one cube, ``(2, 2, 2)``, with random sizes."""
    size = torch.rand(8, generator=torch.Generator().manual_seed(case)) + 0.01
    inside = torch.tensor([case >> k & 1 for k in range(8)], dtype=torch.bool)
    return torch.where(inside, -size, size).view(2, 2, 2).permute(2, 1, 0)  # corner 1 is one step in x


def test_every_sign_pattern_is_a_closed_outward_manifold(device):
    blocks = [F.pad(sign_pattern(case), (1,) * 6, value=0.5) for case in range(256)]
    level = torch.cat([torch.cat(blocks[16 * k : 16 * k + 16], 0) for k in range(16)], 1).to(device)
    found = report(extract_surface(level, radius=1.0, **random_weights(level.shape, 0, device)))
    assert found.watertight and found.manifold and found.degenerate_faces == 0, found
    # weights beyond the range of the published activations may fold a thin part over; within it none does
    mesh = extract_surface(level, radius=1.0, **random_weights(level.shape, 0, device, spread=0.5))
    label = face_components(mesh)
    a, b, c = (mesh.vertices[mesh.faces[:, k].long()].double() for k in range(3))
    volumes = torch.zeros(int(label.max()) + 1, device=device, dtype=torch.float64)
    volumes.index_add_(0, label, (a * torch.linalg.cross(b, c)).sum(-1))
    assert bool((volumes > 0).all())


@pytest.mark.parametrize("case", range(1, 255, 11))
def test_one_cube_is_closed_at_the_box(device, case):
    level = sign_pattern(case).contiguous().to(device)
    mesh = extract_surface(level, radius=1.0, **random_weights(level.shape, case, device))
    found = report(mesh)
    assert found.watertight and found.manifold, found
    assert float(volume(mesh)) > 0


@pytest.mark.parametrize("seed", range(6))
def test_noise_is_a_closed_manifold_with_the_inside_on_the_inner_side(device, seed):
    rng = torch.Generator().manual_seed(seed)
    level = torch.randn(9, 10, 12, generator=rng).to(device)  # all ambiguous cases, faces at the box too
    level[level.abs() < 0.05] = 0.0
    mesh = extract_surface(level, radius=(0.5, 1.0, 2.0), **random_weights(level.shape, seed, device))
    found = report(mesh)
    assert found.watertight and found.manifold, found
    half = torch.tensor([0.5, 1.0, 2.0], device=device)
    margin = half / (torch.tensor(level.shape, device=device) - 1)  # the grid's own vertices move by half a cube
    assert bool((mesh.vertices.abs() <= half + margin).all())
    # without weights a quad's normal has a positive product with the step from its inside to its outside end
    plain = extract_surface(level, radius=(0.5, 1.0, 2.0))
    inside_volume = (level < 0).float().mean()
    assert 0.3 < float(volume(plain)) / (8 * 0.5 * 1.0 * 2.0) / float(inside_volume) < 1.7


def test_genus_and_components(device):
    assert report(extract_surface(torus(32, device), radius=1.0)).euler == 0
    p = grid(32, device=device)
    centre = torch.tensor([0.5, 0.0, 0.0], device=device)
    two = torch.minimum((p - centre).norm(dim=-1), (p + centre).norm(dim=-1)) - 0.35
    found = report(extract_surface(two, radius=1.0))
    assert (found.components, found.euler) == (2, 4)
    x, y, z = (4 * grid(40, device=device)).unbind(-1)
    gyroid = x.sin() * y.cos() + y.sin() * z.cos() + z.sin() * x.cos()
    found = report(extract_surface(gyroid, radius=1.0))
    assert found.watertight and found.manifold and found.euler < 0


@pytest.mark.parametrize("shape", ["sphere", "torus", "two spheres"])
def test_the_distance_to_the_analytic_surface_is_below_a_cube_both_ways(device, shape):
    n = 32
    u, v = (torch.rand(4000, generator=torch.Generator().manual_seed(k)) * 2 * np.pi for k in (0, 1))
    direction = F.normalize(torch.randn(4000, 3, generator=torch.Generator().manual_seed(2)), dim=1)
    centre = torch.tensor([0.5, 0.0, 0.0])
    if shape == "torus":
        mesh, radius = extract_surface(torus(n, device), radius=1.0), 0.6 + 0.22 * v.cos()
        points = torch.stack([radius * u.cos(), radius * u.sin(), 0.22 * v.sin()], -1)
        away = torch.hypot(torch.hypot(*mesh.vertices.cpu().T[:2]) - 0.6, mesh.vertices.cpu()[:, 2]) - 0.22
    elif shape == "sphere":
        mesh, points = extract_surface(sphere(n, device=device), radius=1.0), 0.6 * direction
        away = mesh.vertices.cpu().norm(dim=-1) - 0.6
    else:
        p = grid(n, device=device)
        level = torch.minimum((p - centre.to(device)).norm(dim=-1), (p + centre.to(device)).norm(dim=-1)) - 0.35
        mesh, points = (
            extract_surface(level, radius=1.0),
            0.35 * direction + torch.where(u[:, None] > 3, centre, -centre),
        )
        at = mesh.vertices.cpu()
        away = torch.minimum((at - centre).norm(dim=-1), (at + centre).norm(dim=-1)) - 0.35
    cube = 2 / n
    assert float(away.abs().max()) < cube
    corners = mesh.vertices[mesh.faces.long()].cpu()
    samples = torch.cat(
        [corners.reshape(-1, 3), corners.mean(1)]
    )  # no point of a face is further from one than half a cube
    assert cKDTree(samples.numpy()).query(points.numpy())[0].max() < cube


def test_sphere_converges_with_second_order(device):
    errors = []
    for n in (16, 32, 64):
        mesh = extract_surface(sphere(n, device=device), radius=1.0)
        assert (mesh.vertices.norm(dim=-1) - 0.6).abs().max() < 2 / n  # within a cube
        outward = (face_normals(mesh.vertices, mesh.faces) * mesh.vertices[mesh.faces[:, 0].long()]).sum(-1)
        assert bool((outward > 0).all())
        errors.append(abs(float(volume(mesh)) - 4 / 3 * np.pi * 0.6**3))
    slopes = np.log2(np.array(errors[:-1]) / np.array(errors[1:]))
    assert slopes.min() > 1.8, slopes


def test_a_half_space_is_closed_flat_at_the_box(device):
    level = grid(12, device=device)[..., 1] - 0.05
    closed = extract_surface(level, radius=1.5)
    found = report(closed)
    assert found.watertight and found.manifold and found.euler == 2
    assert closed.vertices.abs().max() == 1.5
    # box of 3 x 1.575 x 3 but for the chamfered edges, half a cube of 0.25 on each side: under 3 % of the volume
    exact = 3.0 * 3.0 * 1.5 * 1.05
    assert 0.97 * exact < float(volume(closed)) <= exact * (1 + 1e-6)
    opened = report(extract_surface(level, radius=1.5, closed=False))
    assert opened.boundary_edges > 0
    away = sphere(12, device=device)
    one, other = extract_surface(away, radius=1.0), extract_surface(away, radius=1.0, closed=False)
    assert torch.equal(one.vertices, other.vertices) and torch.equal(one.faces, other.faces)


def test_gradients_match_the_plain_float64_formulation(device):
    rng = torch.Generator().manual_seed(3)
    level = torch.randn(7, 6, 8, generator=rng)
    level = F.pad(level, (1,) * 6, value=0.7)  # the plain formulation has no padding; away from the box both agree
    weights = random_weights(level.shape, 5, spread=0.5)
    gamma = weights.pop("gamma")
    leaves = {"level": level, **weights}
    ours = {k: v.to(device).requires_grad_() for k, v in leaves.items()}
    mesh = extract_surface(ours["level"], radius=0.8, gamma=gamma.to(device), **{k: ours[k] for k in weights})
    double = {k: v.double().requires_grad_() for k, v in leaves.items()}
    want, _ = reference_surface.flexicubes_vertices(
        double["level"], double["deformation"], double["alpha"], double["beta"], 1.6)  # fmt: skip
    tree = cKDTree(mesh.vertices.detach().cpu().numpy())
    distance, match = tree.query(want.detach().numpy())
    assert len(want) == len(mesh.vertices) == len(set(match.tolist()))
    assert distance.max() < 1e-6  # float32 quotients of coordinates below 1
    share = torch.randn(len(want), 3, generator=rng)
    placed = torch.empty_like(share)
    placed[torch.from_numpy(match)] = share
    got = torch.autograd.grad((mesh.vertices * placed.to(device)).sum(), list(ours.values()))
    true = torch.autograd.grad((want * share.double()).sum(), list(double.values()))
    for name, a, b in zip(ours, got, true, strict=True):
        scale = b.abs().max()
        # quotients by level differences down to 1e-3 of the level amplify float32 rounding to 1e-5
        torch.testing.assert_close(a.cpu().double() / scale, b / scale, rtol=1e-4, atol=2e-5, msg=name)


def test_the_float64_formulation_has_the_gradients_of_finite_differences():
    level = F.pad(torch.randn(3, 4, 3, generator=torch.Generator().manual_seed(6)), (1,) * 6, value=0.7)
    weights = random_weights(level.shape, 5, spread=0.5)
    leaves = [v.double().requires_grad_() for v in (level, *(weights[k] for k in ("deformation", "alpha", "beta")))]
    assert torch.autograd.gradcheck(lambda *x: reference_surface.flexicubes_vertices(*x, 1.6)[0], leaves, eps=1e-6,
                                    atol=1e-5, rtol=1e-3, fast_mode=True)  # fmt: skip


def test_layout_of_the_inputs_does_not_matter_and_gradients_stop_where_none_is_asked(device):
    level = torus(10, device)
    weights = random_weights(level.shape, 4, device)
    weights["alpha"] = weights["alpha"][:1].expand(1000, 8)
    want = extract_surface(level, radius=1.0, **weights)
    strided = {name: torch.stack([value, value], -1)[..., 1] for name, value in weights.items()}
    beta = strided["beta"] = strided["beta"].requires_grad_()
    turned = level.permute(2, 0, 1).contiguous().permute(1, 2, 0)
    assert not turned.is_contiguous() and not beta.is_contiguous()
    got = extract_surface(turned, radius=1.0, **strided)
    assert torch.equal(got.vertices.detach(), want.vertices) and torch.equal(got.faces, want.faces)
    loss = got.vertices.square().sum()
    (first,) = torch.autograd.grad(loss, beta, retain_graph=True)
    assert torch.equal(first, torch.autograd.grad(loss, beta, retain_graph=True)[0]) and first.shape == beta.shape
    (twice,) = torch.autograd.grad(loss, beta, create_graph=True)
    with pytest.raises(RuntimeError, match="once_differentiable"):
        twice.sum().backward()
    leaf = level.clone().requires_grad_()
    held = leaf * 1.0
    mesh = extract_surface(held, radius=1.0)
    held.mul_(2.0)
    with pytest.raises(RuntimeError, match="inplace"):
        mesh.vertices.sum().backward()


@pytest.mark.parametrize("seed", range(4))
def test_levels_and_weights_of_any_size_give_finite_vertices_and_gradients(device, seed):
    rng = torch.Generator().manual_seed(seed)
    shape = (12, 11, 10)
    level = torch.randn(shape, generator=rng) * 10.0 ** torch.randint(-6, 7, shape, generator=rng)
    level[torch.rand(shape, generator=rng) < 0.1] = 0.0
    level[torch.rand(shape, generator=rng) < 0.1] = -0.0
    cubes = 11 * 10 * 9
    alpha, beta = (10.0 ** torch.randint(-3, 4, (cubes, n), generator=rng) for n in (8, 12))
    leaves = [v.to(device).requires_grad_() for v in (level, alpha, beta)]
    mesh = extract_surface(leaves[0], radius=1.0, alpha=leaves[1], beta=leaves[2])
    found = report(mesh.detach())
    assert found.boundary_edges == 0 and float(mesh.vertices.detach().abs().max()) <= 1.0 + 1e-6  # rounding of a mean
    grads = torch.autograd.grad(mesh.vertices.sum(), leaves)
    assert all(bool(torch.isfinite(g).all()) for g in grads) and all(float(g.abs().max()) > 0 for g in grads)


def test_the_peer_that_is_timed_gives_the_same_surface():
    level = F.pad(torch.randn(9, 8, 10, generator=torch.Generator().manual_seed(8)), (1,) * 6, value=0.7)
    weights = random_weights(level.shape, 2, spread=0.5)
    mesh = extract_surface(level, radius=0.8, **weights)
    vertices, faces = flexicubes(level, *(weights[k] for k in ("deformation", "alpha", "beta", "gamma")),
                                 cube_list(level.shape), 1.6)  # fmt: skip
    distance, match = cKDTree(mesh.vertices.numpy()).query(vertices.numpy())
    assert len(vertices) == len(mesh.vertices) and distance.max() < 1e-6  # float32 quotients of coordinates below 1

    def listed(faces):
        turned = np.stack([np.roll(f, -int(f.argmin())) for f in faces])
        return turned[np.lexsort(turned.T)]

    assert np.array_equal(listed(match[faces.numpy()]), listed(mesh.faces.numpy()))


def test_gradients_match_finite_differences_of_the_kernel(device):
    level = sphere(6, device=device) + 0.05
    rng = torch.Generator().manual_seed(0)
    weights = random_weights(level.shape, 1, device, spread=0.4)
    direction = torch.randn(level.shape, generator=rng).to(device)
    share = None
    values = []
    leaf = level.clone().requires_grad_()
    for step in (-1e-2, 1e-2, 0.0):
        mesh = extract_surface(leaf + step * direction * level.abs(), radius=1.0, centre=True, **weights)
        if share is None:
            share = torch.randn(mesh.vertices.shape, generator=rng).to(device)
        values.append((mesh.vertices * share).sum())
    (got,) = torch.autograd.grad(values[2], leaf)
    slope = float(((values[1] - values[0]) / 2e-2).detach())  # steps that scale with the level keep its signs
    assert abs(float((got * direction * level.abs()).sum()) - slope) < 2e-3 * max(1.0, abs(slope))  # float32, step**2


def test_gradients_in_the_padding_reach_what_they_stand_at(device):
    level = grid(5, device=device)[..., 0] + 0.1
    leaf = level.clone().requires_grad_()
    shift = torch.zeros(6, 6, 6, 3, device=device).requires_grad_()
    mesh = extract_surface(leaf, radius=1.0, deformation=shift)
    g_level, g_shift = torch.autograd.grad(mesh.vertices.square().sum(), (leaf, shift))
    assert bool(torch.isfinite(g_level).all()) and bool(torch.isfinite(g_shift).all())
    # the total weight of a vertex is one: moving the whole grid moves every vertex
    (whole,) = torch.autograd.grad(extract_surface(leaf, radius=1.0, deformation=shift).vertices.sum(), shift)
    torch.testing.assert_close(whole.sum((0, 1, 2)), torch.full((3,), 2.0 * len(mesh.vertices), device=device))


def test_centre_vertices_split_quads_in_four_with_gradient_to_gamma(device):
    level = torus(12, device)
    weights = random_weights(level.shape, 2, device)
    gamma = weights["gamma"].requires_grad_()
    two = extract_surface(level, radius=1.0, **weights)
    four = extract_surface(level, radius=1.0, centre=True, **weights)
    quads = len(two.faces) // 2
    assert len(four.faces) == 4 * quads and len(four.vertices) == len(two.vertices) + quads
    found = report(four.detach())
    assert found.watertight and found.manifold and found.euler == 0
    assert torch.equal(four.vertices[: len(two.vertices)], two.vertices)
    assert two.vertices.requires_grad is False
    share = torch.randn(four.vertices.shape, generator=torch.Generator().manual_seed(0)).to(device)
    (got,) = torch.autograd.grad((four.vertices * share).sum(), gamma)
    direction = torch.rand(gamma.shape, generator=torch.Generator().manual_seed(1)).to(device) * gamma.detach()
    ends = []
    for step in (-1e-3, 1e-3):
        weights["gamma"] = gamma.detach() + step * direction
        moved = extract_surface(level, radius=1.0, centre=True, **weights).vertices
        ends.append((moved.double() * share.double()).sum())
    slope = float((ends[1] - ends[0]) / 2e-3)
    assert abs(float((got * direction).sum()) - slope) < 2e-2 * max(1.0, abs(slope))  # float32 over a step of 1e-3


def test_weights_of_surface_cubes_only(device):
    for level in (sphere(10, device=device), grid(10, device=device)[..., 2] + 0.03):
        weights = random_weights(level.shape, 0, device)
        dense = extract_surface(level, radius=1.0, **weights)
        cubes = surface_cubes(level)
        rows = {k: v if k == "deformation" else v[cubes].requires_grad_() for k, v in weights.items()}
        got = extract_surface(level, radius=1.0, cubes=cubes, **rows)
        assert torch.equal(got.vertices, dense.vertices) and torch.equal(got.faces, dense.faces)
        g_alpha, g_beta = torch.autograd.grad(got.vertices.square().sum(), (rows["alpha"], rows["beta"]))
        full = {k: v.clone().requires_grad_() for k, v in weights.items()}
        again = extract_surface(level, radius=1.0, **full)
        f_alpha, f_beta = torch.autograd.grad(again.vertices.square().sum(), (full["alpha"], full["beta"]))
        assert torch.equal(g_alpha, f_alpha[cubes]) and torch.equal(g_beta, f_beta[cubes])
        with pytest.raises(ValueError, match="cubes"):
            extract_surface(level, radius=1.0, cubes=cubes.flip(0), **rows)


def test_the_same_bits_for_any_number_of_threads():
    level = torus(40) + 0.01 * torch.randn(41, 41, 41, generator=torch.Generator().manual_seed(0))
    weights = random_weights(level.shape, 0)
    before = torch.get_num_threads()
    results = []
    try:
        for threads in (1, 2, 5):
            torch.set_num_threads(threads)
            leaves = [level.clone().requires_grad_(), weights["deformation"].clone().requires_grad_()]
            mesh = extract_surface(leaves[0], radius=1.0, **{**weights, "deformation": leaves[1]})
            grads = torch.autograd.grad(mesh.vertices.square().sum(), leaves)
            results.append((mesh.vertices.detach(), mesh.faces, *grads))
    finally:
        torch.set_num_threads(before)
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other, strict=True))


@pytest.mark.parametrize(
    "change, error, name",
    [
        (dict(level=torch.ones(4, 4, 4)), ValueError, "level"),
        (dict(level=-torch.ones(4, 4, 4)), ValueError, "level"),
        (dict(level=torch.zeros(4, 4, 4)), ValueError, "level"),
        (dict(level=torch.full((4, 4, 4), float("nan"))), ValueError, "level"),
        (dict(level=torch.eye(4).expand(4, 4, 4).sub(0.5) * float("inf")), ValueError, "level"),
        (dict(level=torch.ones(4, 4)), ValueError, "level"),
        (dict(level=torch.ones(1, 4, 4)), ValueError, "level"),
        (dict(level=torch.ones(4, 4, 4, dtype=torch.float64)), TypeError, "level"),
        (dict(radius=0.0), ValueError, "radius"),
        (dict(radius=(1.0, 2.0)), ValueError, "radius"),
        (dict(alpha=torch.ones(63, 8)), ValueError, "alpha"),
        (dict(beta=torch.ones(64, 8)), ValueError, "beta"),
        (dict(gamma=torch.ones(64, 1)), ValueError, "gamma"),
        (dict(gamma=torch.ones(64, dtype=torch.float16)), TypeError, "gamma"),
        (dict(deformation=torch.zeros(4, 4, 4, 3)), ValueError, "deformation"),
        (dict(alpha=-torch.ones(64, 8)), ValueError, "alpha"),
        (dict(beta=torch.zeros(64, 12)), ValueError, "beta"),
        (dict(deformation=torch.full((5, 5, 5, 3), float("nan"))), ValueError, "deformation"),
        (dict(cubes=torch.zeros(3, dtype=torch.int64)), ValueError, "cubes"),
    ],
)
def test_wrong_input_is_named(change, error, name):
    arguments = dict(level=sphere(4), radius=1.0) | change
    with pytest.raises(error, match=name):
        extract_surface(arguments.pop("level"), **arguments)
