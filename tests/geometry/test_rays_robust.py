"""What renderers break on: rays at edges and vertices, spawned rays, thin gaps, moved meshes, odd numbers.

After Embree's ``verify`` and pbrt's ``shapes_test``; the oracle is float64 brute force over all faces, or closed form.
"""

import subprocess
import sys

import numpy as np
import pytest
import torch
import trimesh

from reli3d.geometry.hits import hit_normals, interpolate
from reli3d.render.environment import Environment
from reli3d.render.shading import shade
from tests.support.checkout import ROOT
from tests.support.rays import BACKENDS, PLACES, bumpy, make, offset_origin, placed, rays, soup
from tests.support.scenes import sky
from tests.support.surfaces import at


def oracle(vertices, faces, o, d):
    """Every face for every ray in float64: t ``(N, F)``, inf for a miss, and how far inside its edges a hit lies,
    ``(N, F)`` as the least barycentric weight."""
    v = torch.as_tensor(vertices, dtype=torch.float64)[torch.as_tensor(faces, dtype=torch.long)]
    e1, e2 = (v[:, 1] - v[:, 0])[None], (v[:, 2] - v[:, 0])[None]
    o, d = o.cpu().double()[:, None], d.cpu().double()[:, None]
    p, s = torch.linalg.cross(d, e2), o - v[None, :, 0]
    q = torch.linalg.cross(s, e1.expand_as(s))
    det = (e1 * p).sum(-1)
    u, w, t = (s * p).sum(-1) / det, (d * q).sum(-1) / det, (e2 * q).sum(-1) / det
    inside = torch.minimum(torch.minimum(u, w), 1 - u - w)
    return torch.where((inside >= 0) & (t >= 0), t, torch.inf), torch.where(t >= 0, inside, -torch.inf)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("stretch, shift", PLACES)
@pytest.mark.parametrize("meshes, calls", [(2, 2), pytest.param(20, 20, marks=pytest.mark.slow)])
def test_hits_are_those_of_float64_brute_force(device, backend, stretch, shift, meshes, calls):
    """The same face, or a distance within 1e-5 of the mesh's size; any other ray passes an edge within rounding.
    Directions are stretched as the mesh is, so that ``t`` has the same size everywhere."""
    different = 0
    for seed in range(meshes):
        mesh, faces = bumpy(seed) if seed % 2 else soup(seed, 40 + 10 * seed)
        vertices = placed(mesh, *rays(1), stretch, shift)[0]
        scene = make(vertices, faces, backend, device)
        for k in range(calls):
            plain = rays(1000, 100 * seed + k, 1.5)
            _, o, d = placed(mesh, *plain, stretch, shift)
            hits = scene.closest(o.to(device), d.to(device))
            t, inside = oracle(vertices, faces, o, d)
            best, first = t.min(1)
            assert torch.equal(scene.occluded(o.to(device), d.to(device)), hits.face >= 0)
            assert bool((hits.t[hits.face < 0].isinf()).all()) and not bool(hits.bary[hits.face < 0].any())
            face, got = hits.face.cpu().long(), hits.t.cpu().double()
            same = face == torch.where(best.isinf(), -1, first)
            # t counts in lengths of d, which is stretched as the mesh is; the mesh was 3 across
            near = (got - best).abs() <= 1e-5 * 3.0 / plain[1].norm(dim=-1)
            odd = torch.nonzero(~(same | near))[:, 0]
            different += len(odd)
            for i in odd.tolist():  # both faces in question: an edge of either is within 1e-5 of its size
                margins = [float(inside[i, f]) for f in (int(face[i]), int(first[i])) if f >= 0 and not best[i].isinf()]
                assert min(abs(m) for m in margins) < 1e-5, (seed, k, i)
    assert different <= max(1, 1e-5 * meshes * calls * 1000)


@pytest.mark.parametrize("backend", BACKENDS)
def test_any_hit_is_the_closest_hit_before_the_limit(device, backend):
    """Limits of every ray's own: any, exactly at the closest hit, which is then none, and the next number above it."""
    vertices, faces = soup(4, 200)
    scene, n = make(vertices, faces, backend, device), 120_000
    o, d = (v.to(device) for v in rays(n, 9, 0.8))
    first = scene.closest(o, d).t
    far = torch.rand(n, generator=torch.Generator().manual_seed(3)).to(device) * 2.0
    far[1::3] = first[1::3]
    far[2::3] = torch.nextafter(first[2::3], torch.full_like(first[2::3], torch.inf))
    found = scene.occluded(o, d, t_max=far)
    assert torch.equal(found, first < far)
    assert float(found[::3].float().mean()) > 0.1 and float(found[2::3].float().mean()) > 0.3
    limited = scene.closest(o, d, t_max=far)
    assert torch.equal(limited.t, torch.where(found, first, torch.inf)) and torch.equal(limited.face >= 0, found)


@pytest.mark.parametrize("backend", BACKENDS)
def test_small_triangles_are_hit_where_they_are_aimed_at(device, backend):
    """Embree's SmallTriangleHit: a plane of 100 x 100 squares; and both ways to the point agree to 16 ulp."""
    grid = np.stack(np.meshgrid(np.arange(101.0), np.arange(101.0), indexing="ij"), -1).reshape(-1, 2)
    vertices = np.concatenate([grid, np.zeros((len(grid), 1))], 1).astype(np.float32)
    a = (np.arange(100)[:, None] * 101 + np.arange(100)).reshape(-1)
    faces = np.concatenate([np.stack([a, a + 101, a + 1], 1), np.stack([a + 1, a + 101, a + 102], 1)]).astype(np.int32)
    scene, rng = make(vertices, faces, backend, device), np.random.default_rng(0)
    target = (vertices[faces] * np.float32([[0.5], [0.3], [0.2]])).sum(1)  # no two weights are equal
    target = torch.from_numpy(target).to(device)
    o = torch.tensor(rng.uniform([0, 0, 20], [100, 100, 90], (len(faces), 3)), dtype=torch.float32, device=device)
    hits = scene.closest(o, target - o)
    assert float((hits.face.cpu() != torch.arange(len(faces), dtype=torch.int32)).float().mean()) <= 2e-5
    along = o + hits.t[:, None] * (target - o)
    across = interpolate(scene.vertices, scene.faces, hits.face, hits.bary)
    assert float((along - across).abs().max()) <= 16 * 2.0**-24 * 128  # ulp of coordinates up to 100


def shaded(scene, face, bary):
    """Radiance of points of the scene's own surface under its own shadows."""
    n, device = len(face), face.device
    position, ng = interpolate(scene.vertices, scene.faces, face, bary), hit_normals(scene.vertices, scene.faces, face)
    white, half = torch.full((n, 3), 0.8, device=device), torch.full((n,), 0.5, device=device)
    return shade(*at(position, ng, ng, ng, white, half, half), Environment(sky().radiance.to(device)), scene=scene)


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_moved_mesh_is_hit_as_if_built_anew(device, backend):
    vertices, faces = bumpy(5, subdivisions=3)
    scene = make(vertices, faces, backend, device)
    o, d = (v.to(device) for v in rays(20_000, 8, 1.2))
    far = torch.rand(20_000, generator=torch.Generator().manual_seed(1)).to(device) * 2.0
    rng = np.random.default_rng(2)
    face = torch.tensor(rng.integers(0, len(faces), 500), dtype=torch.int32, device=device)
    bary = torch.tensor(rng.dirichlet((1, 1, 1), 500)[:, 1:], dtype=torch.float32, device=device)
    for seed, place in ((6, 0.2), (7, 0.2), (8, 40.0)):  # the last one needs a larger scale than the first
        moved, _ = bumpy(seed, subdivisions=3, height=0.4)
        moved = moved * np.float32([1.0, 1.5, 0.7]) + np.float32(place)
        before = shaded(scene, face, bary)
        scene.refit(torch.from_numpy(moved).to(device))
        fresh = make(moved, faces, backend, device)
        assert scene.scale == fresh.scale and (scene.mesh_id == 0) == (backend == "embree")
        start = o + place - 0.2
        got, expected = scene.closest(start, d), fresh.closest(start, d)
        # two faces at one edge may be found in another order, at the same distance
        assert float((got.face != expected.face).float().mean()) <= 1e-4
        torch.testing.assert_close(got.t, expected.t, rtol=0, atol=1e-5)
        for limit in (float("inf"), far):
            blocked = scene.occluded(start, d, t_max=limit)
            assert torch.equal(blocked, fresh.occluded(start, d, t_max=limit)) and float(blocked.float().mean()) > 0.1
        after = shaded(scene, face, bary)
        assert torch.equal(after, shaded(fresh, face, bary)) and float((after - before).abs().max()) > 0.1


HOSTILE = """
import torch
from reli3d.geometry.rays import RayScene
o, d = torch.tensor([[0.2, 0.2, 1.0]]), torch.tensor([[0.0, 0.0, -1.0]])
corners, one = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]), torch.tensor([[0, 1, 2]], dtype=torch.int32)

def properties(scene):
    many = o.expand(20_000, 3), d.expand(20_000, 3)
    t = round(float(scene.closest(o, d).t), 5)  # Embree's reciprocal is approximate: two units in the last place
    return (t, bool(scene.occluded(o, d)), int((scene.closest(*many).face >= 0).sum()),
            bool(scene.unoccluded(o, d, torch.ones(1) * 9.0)))

def refused(name, act):
    try:
        act()
    except ValueError as error:
        assert str(error).startswith(name + ": expected"), error
    else:
        raise AssertionError("accepted: " + name)

for backend in ("embree", "warp"):
    for index in (3, -1, 2**31 - 1, -(2**31)):
        wrong = torch.tensor([[0, 1, 2], [0, index, 2]], dtype=torch.int32)
        refused("faces", lambda: RayScene(corners, wrong, backend=backend))
    refused("faces", lambda: RayScene(corners[:0], one, backend=backend))
    single = RayScene(corners, one, backend=backend)
    assert properties(single) == (1.0, True, 20_000, False)
    for value in (float("nan"), float("inf")):
        broken = corners.clone()
        broken[1, 1] = value
        refused("vertices", lambda: RayScene(broken, one, backend=backend))
        refused("vertices", lambda: single.refit(broken))
        assert properties(single) == (1.0, True, 20_000, False) and single.scale == 1.0  # as it was
    refused("vertices", lambda: single.refit(corners[:2]))
    single.refit(corners - torch.tensor([0.0, 0.0, 1.0]))
    assert properties(single) == (2.0, True, 20_000, False)
    for vertices in (corners, corners[:0]):
        empty = RayScene(vertices, one[:0], backend=backend)
        for _ in range(2):
            assert properties(empty) == (float("inf"), False, 0, True) and empty.mesh_id == 0
            empty.refit(vertices.clone())
print("all refused or answered")
"""


def test_wrong_indices_and_odd_meshes_end_in_an_error_and_never_in_a_crash():
    """In a process of its own: a wrong index that came through would end it with a signal."""
    done = subprocess.run([sys.executable, "-c", HOSTILE], capture_output=True, text=True, timeout=300, cwd=ROOT)
    assert done.returncode == 0 and done.stdout == "all refused or answered\n", done.stderr


@pytest.mark.parametrize("backend", BACKENDS)
def test_no_light_comes_into_a_closed_box_nor_through_a_gap_of_1e_5(device, backend):
    """Shadow leaks.  A closed box: rays from a wall, also from its edges and corners, are blocked.  Two walls at
    distance 1e-5: rays from one into the gap are blocked by the other, so the offset is small enough."""
    rng, n = np.random.default_rng(1), 250_000
    box = trimesh.creation.box((2.0, 2.0, 2.0))
    box = box.subdivide().subdivide()
    scene = make(box.vertices, box.faces, backend, device)
    d = torch.nn.functional.normalize(rays(n, 3)[1], dim=-1).to(device)
    face = torch.tensor(rng.integers(0, len(box.faces), n), dtype=torch.int32, device=device)
    weights = torch.tensor(rng.dirichlet((1, 1, 1), n), dtype=torch.float32, device=device)
    for place, limit in (("wall", 0), ("edge", 5e-5), ("corner", 2e-3)):
        w = weights.clone()
        if place == "edge":
            w[:, 2] = 0.0
        if place == "corner":
            w[:, 1:] = 0.0
        w = w / w.sum(1, keepdim=True)
        position = interpolate(scene.vertices, scene.faces, face, w[:, 1:].contiguous())
        ng = hit_normals(scene.vertices, scene.faces, face)
        inward = torch.where((d * ng).sum(-1, keepdim=True) > 0.0, -d, d)
        o = offset_origin(position, ng, inward, scene.scale)
        within = (position + 1e-3 * inward).abs().amax(-1) < 1.0  # not along the other wall of an edge
        leaks = ~scene.occluded(o, inward) & within
        assert float(leaks.sum()) <= limit * float(within.sum()), (place, int(leaks.sum()))
    plane = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], np.float32)
    walls = np.concatenate([plane * 0.1, plane + np.float32([0, 0, 1e-5])])
    scene = make(walls, [[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]], backend, device)
    o = torch.tensor(rng.uniform(-0.1, 0.1, (n, 3)) * [1, 1, 0], dtype=torch.float32, device=device)
    up = d * torch.sign(d[:, 2:])
    up = up[up[:, 2] > 0.1]
    o, ng = o[: len(up)], torch.tensor([0.0, 0, 1], device=device).expand(len(up), 3)
    assert bool(scene.occluded(offset_origin(o, ng, up, scene.scale), up).all())


@pytest.mark.parametrize("count", [500, 10_000])  # Embree's are ordered where they are many
@pytest.mark.parametrize("backend", BACKENDS)
def test_tiny_huge_and_invalid_rays_come_to_an_end(device, backend, count):
    """Directions of any float32 length: the right hit or, where t leaves float32, a miss.  Invalid rays among valid
    ones leave those as they were."""
    vertices, faces = bumpy(1)
    scene = make(vertices, faces, backend, device)
    o, d = rays(count, 2, 0.2)
    o, d = o.to(device), torch.nn.functional.normalize(d, dim=-1).to(device)
    expected = scene.closest(o, d)
    for length in (1e-45, 1e-40, 1e-30, 1e-17, 1e-10, 1e10, 1e30, 3e37):
        hits = scene.closest(o, d * length)
        hit = hits.face >= 0
        assert bool(hit.all()) if length > 1e-38 else not bool(hit.any())
        assert float((hits.face == expected.face)[hit].float().sum()) >= 0.999 * float(hit.sum())
        torch.testing.assert_close(hits.t[hit].double() * length, expected.t[hit].double(), rtol=1e-4, atol=0)
        assert bool(torch.isinf(hits.t[~hit]).all()) and torch.equal(scene.occluded(o, d * length), hit)
        far = torch.full((len(o),), float(expected.t.median()) / length if hit.any() else 1e38, device=device)
        near = expected.t < float(expected.t.median()) * (1 - 1e-5)
        assert not hit.any() or bool(scene.occluded(o, d * length, t_max=far)[near].all())
    for value in (float("nan"), float("inf"), -float("inf")):
        for part, axis in np.ndindex(2, 3):
            mixed = [o.clone(), d.clone()]
            mixed[part][1::2, axis] = value
            hits = scene.closest(*mixed)
            assert bool((hits.face[1::2] == -1).all()) and torch.equal(hits.face[::2], expected.face[::2])
            assert torch.equal(scene.occluded(*mixed), hits.face >= 0)
    none = torch.zeros_like(d)
    assert bool((scene.closest(o, none).face == -1).all()) and not bool(scene.occluded(o, none).any())
    for limit in (float("nan"), -1.0, 0.0):
        assert bool((scene.closest(o, d, t_max=limit).face == -1).all())
        assert not bool(scene.occluded(o, d, t_max=limit).any())
