"""FlexiCubes: the published order, topology of every sign pattern, convergence, closed at the box, gradients."""

import numpy as np
import pytest
import torch
from scipy import ndimage
from scipy.spatial import cKDTree

from bench.peers.flexicubes_torch import cube_list, flexicubes
from reli3d.geometry.mesh import face_components, report, vertex_normals
from reli3d.geometry.regularize import vertex_deviation
from reli3d.geometry.smooth import taubin_smooth
from reli3d.geometry.surface import CubeWeights, extract_surface, surface_cubes
from reli3d.geometry.triplane import sample_triplane
from reli3d.geometry.uv import unwrap
from tests.support.meshes import volume
from tests.support.reference_surface import grid, random_weights, sphere, torus

F = torch.nn.functional


@pytest.mark.parametrize("name", ["sphere", "sphere_w", "smooth_w", "noise_w"])
def test_vertices_and_faces_are_the_published_ones_in_their_order(goldens, device, name):
    data = np.load(goldens / "flexicubes_16.npz")
    raw = torch.from_numpy(data["weights21"]).to(device)
    sdf = torch.from_numpy(data[f"{name}.level"]).view(17, 17, 17).to(device)
    weights = {}
    if name != "sphere":
        shift = torch.from_numpy(data["deformation"]).view(17, 17, 17, 3).to(device)
        weights = dict(
            beta=1 + 0.5 * raw[:, :12].tanh(),
            alpha=1 + 0.5 * raw[:, 12:20].tanh(),
            gamma=0.25 + 0.5 * raw[:, 20].sigmoid(),
            deformation=shift.tanh() * (1 - 1e-8) / 32,
        )
    got = extract_surface(sdf, radius=0.5, closed=False, weights=CubeWeights(**weights))
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
    sdf = 10 - (mlp(p, "net.heads.density", features, 3) - 1).exp().view(17, 17, 17)
    offset = mlp(p, "net.heads.vertex-offset", features, 3).view(17, 17, 17, 3)
    corner = mlp(p, "net.heads.flexicubes-weight", features, 2).view(17, 17, 17, 16)
    eight = [corner[i : i + 16, j : j + 16, k : k + 16] for k in (0, 1) for j in (0, 1) for i in (0, 1)]
    merged = 0.1 * mlp(p, "indices_merging_mlp.heads.flexicubes-weight", torch.cat(eight, -1).view(-1, 128), 3)
    np.testing.assert_allclose(merged[:64].numpy(), data["weight21_first64"], rtol=0, atol=2e-6)
    weights = CubeWeights(
        deformation=offset.tanh() * (1 - 1e-8) / 32,
        beta=1 + 0.5 * merged[:, :12].tanh(),
        alpha=1 + 0.5 * merged[:, 12:20].tanh(),
        gamma=0.25 + 0.5 * merged[:, 20].sigmoid(),
    )
    got = extract_surface(sdf, radius=0.87, closed=False, weights=weights)
    assert np.array_equal(got.faces.numpy(), data["faces"])
    # density is exp of a sum of 64 products: 1e-5 relative, over gradients of about 1 a cell of 0.1
    np.testing.assert_allclose(got.vertices.numpy(), data["v_pos"], rtol=0, atol=1e-5)
    difference = (vertex_normals(got.vertices, got.faces) - torch.from_numpy(data["v_nrm"])).abs()
    assert difference.quantile(0.999) < 1e-3  # slivers turn with the last digits of their corners


def sign_pattern(case):
    """Field values ``(2, 2, 2)`` of one cube with the signs of ``case`` and random magnitudes."""
    size = torch.rand(8, generator=torch.Generator().manual_seed(case)) + 0.01
    inside = torch.tensor([case >> k & 1 for k in range(8)], dtype=torch.bool)
    return torch.where(inside, -size, size).view(2, 2, 2).permute(2, 1, 0)  # corner 1 is one step in x


def test_every_sign_pattern_is_a_closed_outward_manifold_with_a_ball_for_every_connected_part(device):
    """Inside corners not connected by cube edges are separate components without handles: Euler number 2 each."""
    blocks = [F.pad(sign_pattern(case), (1,) * 6, value=0.5) for case in range(256)]
    sdf = torch.cat([torch.cat(blocks[16 * k : 16 * k + 16], 0) for k in range(16)], 1).to(device)
    found = report(extract_surface(sdf, radius=1.0, weights=CubeWeights(**random_weights(sdf.shape, 0, device))))
    assert found.watertight and found.manifold and found.degenerate_faces == 0, found
    parts = sum(ndimage.label(block.numpy() < 0)[1] for block in blocks)
    assert (found.components, found.euler) == (parts, 2 * parts)
    # weights beyond the range of the published activations may fold a thin part over; within it none does
    mesh = extract_surface(sdf, radius=1.0, weights=CubeWeights(**random_weights(sdf.shape, 0, device, spread=0.5)))
    label = face_components(mesh)
    a, b, c = (mesh.vertices[mesh.faces[:, k].long()].double() for k in range(3))
    volumes = torch.zeros(int(label.max()) + 1, device=device, dtype=torch.float64)
    volumes.index_add_(0, label, (a * torch.linalg.cross(b, c)).sum(-1))
    assert bool((volumes > 0).all())


@pytest.mark.parametrize("case", range(1, 255, 11))
def test_one_cube_is_closed_at_the_box(device, case):
    sdf = sign_pattern(case).contiguous().to(device)
    mesh = extract_surface(sdf, radius=1.0, weights=CubeWeights(**random_weights(sdf.shape, case, device)))
    found = report(mesh)
    assert found.watertight and found.manifold, found
    assert volume(mesh) > 0


@pytest.mark.parametrize("seed", range(6))
def test_noise_is_a_closed_manifold_with_the_inside_on_the_inner_side(device, seed):
    rng = torch.Generator().manual_seed(seed)
    sdf = torch.randn(9, 10, 12, generator=rng).to(device)  # all ambiguous cases, faces at the box too
    sdf[sdf.abs() < 0.05] = 0.0
    mesh = extract_surface(sdf, radius=(0.5, 1.0, 2.0), weights=CubeWeights(**random_weights(sdf.shape, seed, device)))
    found = report(mesh)
    assert found.watertight and found.manifold, found
    half = torch.tensor([0.5, 1.0, 2.0], device=device)
    margin = half / (torch.tensor(sdf.shape, device=device) - 1)  # the grid's own vertices move by half a cube
    assert bool((mesh.vertices.abs() <= half + margin).all())
    # without weights a quad's normal has a positive product with the step from its inside to its outside end
    plain = extract_surface(sdf, radius=(0.5, 1.0, 2.0))
    inside_volume = (sdf < 0).float().mean()
    assert 0.3 < volume(plain) / (8 * 0.5 * 1.0 * 2.0) / float(inside_volume) < 1.7


def test_a_half_space_is_closed_flat_at_the_box(device):
    sdf = grid(12, device=device)[..., 1] - 0.05
    closed = extract_surface(sdf, radius=1.5)
    found = report(closed)
    assert found.watertight and found.manifold and found.euler == 2
    assert closed.vertices.abs().max() == 1.5
    # box of 3 x 1.575 x 3 but for the chamfered edges, half a cube of 0.25 on each side: under 3 % of the volume
    exact = 3.0 * 3.0 * 1.5 * 1.05
    assert 0.97 * exact < volume(closed) <= exact * (1 + 1e-6)
    opened = report(extract_surface(sdf, radius=1.5, closed=False))
    assert opened.boundary_edges > 0
    away = sphere(12, device=device)
    one, other = extract_surface(away, radius=1.0), extract_surface(away, radius=1.0, closed=False)
    assert torch.equal(one.vertices, other.vertices) and torch.equal(one.faces, other.faces)


def test_the_peer_that_is_timed_gives_the_same_surface():
    sdf = F.pad(torch.randn(9, 8, 10, generator=torch.Generator().manual_seed(8)), (1,) * 6, value=0.7)
    weights = random_weights(sdf.shape, 2, spread=0.5)
    mesh = extract_surface(sdf, radius=0.8, weights=CubeWeights(**weights))
    vertices, faces = flexicubes(
        sdf, *(weights[k] for k in ("deformation", "alpha", "beta", "gamma")), cube_list(sdf.shape), 1.6
    )
    distance, match = cKDTree(mesh.vertices.numpy()).query(vertices.numpy())
    assert len(vertices) == len(mesh.vertices) and distance.max() < 1e-6  # float32 quotients of coordinates below 1

    def listed(faces):
        turned = np.stack([np.roll(f, -int(f.argmin())) for f in faces])
        return turned[np.lexsort(turned.T)]

    assert np.array_equal(listed(match[faces.numpy()]), listed(mesh.faces.numpy()))


def test_weights_of_surface_cubes_only(device):
    for sdf in (sphere(10, device=device), grid(10, device=device)[..., 2] + 0.03):
        weights = random_weights(sdf.shape, 0, device)
        dense = extract_surface(sdf, radius=1.0, weights=CubeWeights(**weights))
        cubes = surface_cubes(sdf)
        rows = {k: v if k == "deformation" else v[cubes].requires_grad_() for k, v in weights.items()}
        got = extract_surface(sdf, radius=1.0, weights=CubeWeights(cubes=cubes, **rows))
        assert torch.equal(got.vertices, dense.vertices) and torch.equal(got.faces, dense.faces)
        g_alpha, g_beta = torch.autograd.grad(got.vertices.square().sum(), (rows["alpha"], rows["beta"]))
        full = {k: v.clone().requires_grad_() for k, v in weights.items()}
        again = extract_surface(sdf, radius=1.0, weights=CubeWeights(**full))
        f_alpha, f_beta = torch.autograd.grad(again.vertices.square().sum(), (full["alpha"], full["beta"]))
        assert torch.equal(g_alpha, f_alpha[cubes]) and torch.equal(g_beta, f_beta[cubes])
        with pytest.raises(ValueError, match="cubes"):
            extract_surface(sdf, radius=1.0, weights=CubeWeights(cubes=cubes.flip(0), **rows))


@pytest.mark.parametrize(
    "change, name",
    [
        (dict(sdf=torch.full((4, 4, 4), float("nan"))), "sdf"),
        (dict(sdf=torch.eye(4).expand(4, 4, 4).sub(0.5) * float("inf")), "sdf"),
        (dict(sdf=torch.ones(4, 4)), "sdf"),
        (dict(sdf=torch.ones(1, 4, 4)), "sdf"),
        (dict(radius=0.0), "radius"),
        (dict(radius=(1.0, 2.0)), "radius"),
        (dict(alpha=torch.ones(63, 8)), "alpha"),
        (dict(beta=torch.ones(64, 8)), "beta"),
        (dict(gamma=torch.zeros(64)), "gamma"),
        (dict(gamma=torch.ones(64, 1)), "gamma"),
        (dict(deformation=torch.zeros(4, 4, 4, 3)), "deformation"),
        (dict(alpha=-torch.ones(64, 8)), "alpha"),
        (dict(beta=torch.zeros(64, 12)), "beta"),
        (dict(deformation=torch.full((5, 5, 5, 3), float("nan"))), "deformation"),
        (dict(cubes=torch.zeros(3, dtype=torch.int64)), "cubes"),
    ],
)
def test_wrong_input_is_named(change, name):
    arguments = dict(sdf=sphere(4), radius=1.0) | change
    with pytest.raises(ValueError, match=name):
        sdf, radius = arguments.pop("sdf"), arguments.pop("radius")
        extract_surface(sdf, radius=radius, weights=CubeWeights(**arguments))


@pytest.mark.parametrize("seed", range(4))
def test_fields_and_weights_of_any_size_give_finite_vertices_and_gradients(device, seed):
    rng = torch.Generator().manual_seed(seed)
    shape = (12, 11, 10)
    sdf = torch.randn(shape, generator=rng) * 10.0 ** torch.randint(-6, 7, shape, generator=rng)
    sdf[torch.rand(shape, generator=rng) < 0.1] = 0.0
    sdf[torch.rand(shape, generator=rng) < 0.1] = -0.0
    cubes = 11 * 10 * 9
    alpha, beta = (10.0 ** torch.randint(-3, 4, (cubes, n), generator=rng) for n in (8, 12))
    leaves = [v.to(device).requires_grad_() for v in (sdf, alpha, beta)]
    mesh = extract_surface(leaves[0], radius=1.0, weights=CubeWeights(alpha=leaves[1], beta=leaves[2]))
    found = report(mesh.detach())
    assert found.boundary_edges == 0 and float(mesh.vertices.detach().abs().max()) <= 1.0 + 1e-6  # rounding of a mean
    grads = torch.autograd.grad(mesh.vertices.sum(), leaves)
    assert all(bool(torch.isfinite(g).all()) for g in grads) and all(float(g.abs().max()) > 0 for g in grads)


def test_gradients_behind_the_mesh_are_bitwise_identical_for_any_number_of_threads(threads):
    """Center vertices, deviation, normals, smoothing, atlas: torch's own scatters add up in any order."""
    sdf = torus(40) + 0.01 * torch.randn(41, 41, 41, generator=torch.Generator().manual_seed(0))
    weights = {"sdf": sdf, **random_weights(sdf.shape, 0, spread=0.5)}
    results = []
    for count in (1, 2, 5, 5):
        threads(count)
        leaves = {k: v.clone().requires_grad_() for k, v in weights.items()}
        given = {k: v for k, v in leaves.items() if k not in ("sdf", "gamma")}
        mesh = extract_surface(
            leaves["sdf"], radius=1.0, center=True, weights=CubeWeights(gamma=leaves["gamma"], **given)
        )
        shown = unwrap(taubin_smooth(mesh.with_normals(), iterations=2), texture_size=64)
        spread = vertex_deviation(leaves["sdf"], radius=1.0, weights=CubeWeights(**given))
        seen = [mesh.vertices, shown.vertices, shown.normals, spread]
        atlas = shown.uv, shown.faces
        rng = torch.Generator().manual_seed(1)
        cotangent = [torch.randn(v.shape, generator=rng) for v in seen]
        results.append([*seen, *atlas, *torch.autograd.grad(seen, list(leaves.values()), cotangent)])
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other, strict=True))


def test_gradients_in_the_padding_reach_their_vertices(device):
    sdf = grid(5, device=device)[..., 0] + 0.1
    leaf = sdf.clone().requires_grad_()
    shift = torch.zeros(6, 6, 6, 3, device=device).requires_grad_()
    mesh = extract_surface(leaf, radius=1.0, weights=CubeWeights(shift))
    g_sdf, g_shift = torch.autograd.grad(mesh.vertices.square().sum(), (leaf, shift))
    assert bool(torch.isfinite(g_sdf).all()) and bool(torch.isfinite(g_shift).all())
    # the total weight of a vertex is one: moving the whole grid moves every vertex
    (whole,) = torch.autograd.grad(extract_surface(leaf, radius=1.0, weights=CubeWeights(shift)).vertices.sum(), shift)
    torch.testing.assert_close(whole.sum((0, 1, 2)), torch.full((3,), 2.0 * len(mesh.vertices), device=device))


def test_center_vertices_split_quads_in_four(device):
    sdf = torus(12, device)
    weights = random_weights(sdf.shape, 2, device)
    weights["gamma"].requires_grad_()
    two = extract_surface(sdf, radius=1.0, weights=CubeWeights(**weights))
    four = extract_surface(sdf, radius=1.0, center=True, weights=CubeWeights(**weights))
    quads = len(two.faces) // 2
    assert len(four.faces) == 4 * quads and len(four.vertices) == len(two.vertices) + quads
    found = report(four.detach())
    assert found.watertight and found.manifold and found.euler == 0
    assert torch.equal(four.vertices[: len(two.vertices)], two.vertices)
    assert two.vertices.requires_grad is False
    assert four.vertices.requires_grad
