"""Procedural objects: closed solids, materials in range, equal from equal seeds; distances against other references."""

import numpy as np
import pytest
import torch
import trimesh

from reli3d.geometry.distance import signed_distance
from reli3d.synthetic import primitives, procedural
from reli3d.synthetic.assembly import Assembly
from reli3d.synthetic.materials import evaluate
from reli3d.synthetic.noise import cells, fbm
from reli3d.synthetic.organic import surface_nets
from reli3d.synthetic.procedural import FRAME_RADIUS, corner_normals, make_object, sample_cameras

SEEDS = range(500, 540)


@pytest.fixture(scope="module")
def objects():
    return [make_object(seed) for seed in SEEDS]


def surface_points(shape, count, seed):
    mesh = trimesh.Trimesh(shape.vertices, shape.faces, process=False)
    points, face = trimesh.sample.sample_surface(mesh, count, seed=seed)
    return points.astype(np.float32), mesh.face_normals[face].astype(np.float32), shape.part[face]


def test_objects_are_closed_solids_of_the_stated_size(objects):
    for shape in objects:
        mesh = trimesh.Trimesh(shape.vertices, shape.faces, process=False)
        assert mesh.is_watertight and mesh.is_winding_consistent and mesh.volume > 0, shape.name
        assert 0 < len(shape.faces) <= procedural.MAX_FACES
        low, high = shape.vertices.min(0), shape.vertices.max(0)
        # float32 rounding of coordinates of size 1
        assert abs((high - low).max() - 1) < 1e-6 and np.abs(low + high).max() < 1e-6
        assert np.linalg.norm(shape.vertices, axis=1).max() < FRAME_RADIUS
        assert shape.part.min() == 0 and shape.part.max() == len(shape.materials) - 1
        types = shape.vertices.dtype, shape.faces.dtype, shape.normals.dtype, shape.part.dtype
        assert types == (np.float32, np.int32, np.float32, np.int32)


def test_shading_normals_are_unit_and_leave_the_surface(objects):
    for shape in objects:
        mesh = trimesh.Trimesh(shape.vertices, shape.faces, process=False)
        # a float32 root and division
        np.testing.assert_allclose(np.linalg.norm(shape.normals, axis=-1), 1, atol=1e-5)
        cosine = (shape.normals * mesh.face_normals[:, None]).sum(-1).min(1)
        # slivers that a cut leaves between two surfaces may take the normal of one of them; they have no area
        assert mesh.area_faces[cosine < 0.3].sum() < 0.02 * mesh.area, shape.name


def material_at(shape, points, normals, part, device="cpu"):
    return evaluate(shape.materials, *(torch.from_numpy(x).to(device) for x in (points, normals, part)))


def test_materials_are_finite_and_in_range(objects):
    for k, shape in enumerate(objects):
        points, normals, part = surface_points(shape, 2000, k)
        color, roughness, metallic, bumped = (x.numpy() for x in material_at(shape, points, normals, part))
        assert color.shape == (2000, 3) and roughness.shape == metallic.shape == (2000,) and bumped.shape == (2000, 3)
        assert all(x.dtype == np.float32 and np.isfinite(x).all() for x in (color, roughness, metallic, bumped))
        # the limits are rounded to float32
        assert color.min() >= 0.02 - 1e-6 and color.max() <= 0.9 + 1e-6
        assert roughness.min() >= 0.08 - 1e-6 and roughness.max() <= 1 and metallic.min() >= 0 and metallic.max() <= 1
        np.testing.assert_allclose(np.linalg.norm(bumped, axis=1), 1, atol=1e-5)
        assert (bumped * normals).sum(1).min() > 0.8  # height gradients are at most 0.6: 31 degrees


def test_an_object_is_the_same_from_the_same_seed():
    for seed in (3, 66, 92, 1020):
        one, two = make_object(seed), make_object(seed)
        assert np.array_equal(one.vertices, two.vertices) and np.array_equal(one.faces, two.faces)
        assert np.array_equal(one.normals, two.normals) and np.array_equal(one.part, two.part)
        points, normals, part = surface_points(one, 500, seed)
        for x, y in zip(material_at(one, points, normals, part), material_at(two, points, normals, part)):
            assert torch.equal(x, y)


@pytest.mark.parametrize("family", [f for f, _ in procedural.FAMILIES], ids=lambda f: f.__name__)
def test_every_family_makes_solids(family):
    made = 0
    for seed in range(4):
        assembly = Assembly(np.random.default_rng((77, seed)))
        family(assembly)
        if assembly.solid_fraction() > 0:
            mesh = procedural.assemble(assembly, family.__name__)
            assert trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).is_watertight
            made += 1
    assert made >= 3


def test_every_device_gives_the_same_material(device):
    shape = make_object(505)
    points, normals, part = surface_points(shape, 3000, 0)
    on_cpu, there = (material_at(shape, points, normals, part, on) for on in ("cpu", device))
    for x, y in zip(on_cpu, there):
        # the same kernels; on a GPU other roundings move a border of a pattern by some ulp, which few points see
        assert ((x - y.cpu()).abs() > 1e-3).float().mean() < 5e-3


def test_material_refuses_wrong_arguments():
    shape = make_object(505)
    points, normals, part = surface_points(shape, 10, 0)
    with pytest.raises(TypeError, match="points: expected torch.float32"):
        material_at(shape, points.astype(np.float64), normals, part)
    with pytest.raises(ValueError, match="normals: expected shape"):
        material_at(shape, points, normals[:5], part)
    with pytest.raises(ValueError, match="part: expected 0 to"):
        material_at(shape, points, normals, part + 100)
    with pytest.raises(ValueError, match="seed: expected at least 0"):
        make_object(-1)


def test_corner_normals_of_a_cube_are_flat_and_of_a_ball_radial():
    cube = trimesh.creation.box()
    normals = corner_normals(np.asarray(cube.vertices), np.asarray(cube.faces))
    np.testing.assert_allclose(normals, np.repeat(cube.face_normals[:, None], 3, 1), atol=1e-6)
    ball = trimesh.creation.icosphere(3)
    normals = corner_normals(np.asarray(ball.vertices), np.asarray(ball.faces))
    # mean of facets that differ by 8 degrees, nearly symmetric about each vertex
    np.testing.assert_allclose(normals, ball.vertices[ball.faces], atol=0.01)


def test_solids_have_the_volumes_of_their_formulas():
    n = 32
    polygon = n / (2 * np.pi) * np.sin(2 * np.pi / n)  # area of the regular polygon over that of its circle
    close = lambda solid, volume: abs(solid.volume() / volume - 1) < 1e-5  # manifold3d keeps vertices to 1e-6
    assert close(primitives.box((1, 2, 3)), 6)
    assert close(primitives.cylinder(0.5, 2, segments=n), np.pi * 0.25 * 2 * polygon)
    assert close(primitives.cylinder(0.5, 2, top=0.25, segments=n), np.pi * 2 / 3 * (0.25 + 0.125 + 0.0625) * polygon)
    assert close(primitives.tube(np.array([[0, 0, 0], [0, 2, 0.0]]), 1.0, segments=4), 4)
    turn = np.linspace(0, 2 * np.pi, 401)[:-1]
    ring = primitives.tube(np.stack([np.cos(turn), 0 * turn, np.sin(turn)], -1), 0.2, closed=True, segments=4)
    assert abs(ring.volume() / (2 * np.pi * 0.08) - 1) < 1e-3  # Pappus; 400 chords
    rounded = primitives.box((1, 1, 1), 0.2)
    exact = 0.6**3 + 6 * 0.36 * 0.2 + 3 * np.pi * 0.04 * 0.6 + 4 / 3 * np.pi * 0.008
    assert 0.97 * exact < rounded.volume() < exact  # facets lie inside the round edge


def test_surface_nets_follow_a_ball():
    x = np.arange(40) - 19.5
    distance = np.sqrt(x[:, None, None] ** 2 + x[None, :, None] ** 2 + x[None, None] ** 2) - 12
    vertices, faces = surface_nets(distance.astype(np.float32))
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    assert mesh.is_watertight and mesh.euler_number == 2
    # a dual surface is inside by about h^2 / (8 r): 0.01 cells a crossing, and the mean of four crossings twice that
    assert np.abs(np.linalg.norm(vertices - 19.5, axis=1) - 12).max() < 0.1
    assert abs(mesh.volume / (4 / 3 * np.pi * 12**3) - 1) < 0.01


def test_noise_gradient_is_the_gradient_of_its_value(device):
    rng = torch.Generator().manual_seed(0)
    points = ((torch.rand(20_000, 3, generator=rng) - 0.5) * 20).to(device)
    value, gradient = fbm(points, octaves=1, seed=4)
    # 20k points in some 8000 cells: the mean of the deviation is good to 2 %
    assert abs(float(value.std()) - 0.5) < 0.05 and abs(float(value.mean())) < 0.02
    for octaves, ridged in ((1, False), (3, False), (3, True)):
        gradient = fbm(points, octaves=octaves, ridged=ridged, seed=9)[1]
        for axis in range(3):
            step = torch.zeros(3, device=device)
            step[axis] = 1e-2
            above, below = (fbm(points + s * step, octaves=octaves, ridged=ridged, seed=9)[0] for s in (1, -1))
            error = ((above - below) / 0.02 - gradient[:, axis]).abs()
            # truncation h^2 f''' / 6 of the third octave (f''' up to 2e3); where ridged, folds within 1e-2 of a point
            assert float(error.median()) < 0.02 and float((error > 0.2).float().mean()) < (0.15 if ridged else 0.02)


def test_cells_are_nearest_and_second_nearest(device):
    points = torch.rand(5000, 3, generator=torch.Generator().manual_seed(1)).mul(6).to(device)
    distance, cell, _ = cells(points, seed=2)
    assert bool((distance[:, 0] <= distance[:, 1]).all()) and float(distance[:, 0].max()) < 1.7
    assert float(cell.min()) >= 0 and float(cell.max()) < 1
    assert 100 < len(torch.unique(cell)) < 1000  # 6^3 cells and those around


def test_signed_distance_agrees_with_trimesh(device):
    shape = make_object(1015)
    mesh = trimesh.Trimesh(shape.vertices, shape.faces, process=False)
    rng = np.random.default_rng(1)
    near = trimesh.sample.sample_surface(mesh, 2000, seed=1)[0] + rng.normal(size=(2000, 3)) * 0.02
    points = np.concatenate([near, rng.uniform(-0.6, 0.6, (2000, 3))]).astype(np.float32)
    arguments = (torch.from_numpy(x).to(device) for x in (shape.vertices, shape.faces, points))
    got = signed_distance(*arguments).cpu().numpy()
    inside = mesh.contains(points)
    assert ((got < 0) == inside)[np.abs(got) > 1e-5].all()  # nearer than that the two round differently
    for k in range(0, len(points), 50):  # every face against a few points: no tree that could be wrong too
        nearest = trimesh.triangles.closest_point(mesh.triangles, np.repeat(points[k : k + 1], len(mesh.faces), 0))
        # a few ulp of coordinates of size 1
        assert abs(np.linalg.norm(nearest - points[k], axis=1).min() - abs(got[k])) < 2e-6


def test_signed_distance_refuses_what_would_crash():
    box = trimesh.creation.box()
    vertices = torch.tensor(np.asarray(box.vertices), dtype=torch.float32)
    faces = torch.tensor(np.asarray(box.faces), dtype=torch.int32)
    points = torch.zeros(4, 3)
    with pytest.raises(ValueError, match="faces: expected at least one"):
        signed_distance(vertices, faces[:0], points)
    with pytest.raises(ValueError, match="faces: expected indices"):
        signed_distance(vertices, faces + 1, points)
    with pytest.raises(TypeError, match="faces: expected torch.int32"):
        signed_distance(vertices, faces.long(), points)
    points[2] = float("nan")
    got = signed_distance(vertices, faces, points)
    assert bool(torch.isnan(got[2])) and float(got[0]) == -0.5
    assert signed_distance(vertices, faces, points[:0]).shape == (0,)


def test_cameras_follow_the_protocol():
    rng = np.random.default_rng(0)
    fields, elevations, distances = [], [], []
    for _ in range(200):
        c2w, fov = sample_cameras(rng, 8)
        assert c2w.shape == (8, 4, 4) and fov.shape == (8,) and c2w.dtype == fov.dtype == np.float32
        rotation, eye = c2w[:, :3, :3], c2w[:, :3, 3]
        np.testing.assert_allclose(rotation @ rotation.transpose(0, 2, 1), np.eye(3)[None].repeat(8, 0), atol=1e-5)
        assert (np.linalg.det(rotation) > 0.99).all() and (rotation[:, 1, 1] > 0).all()  # upright
        across = np.linalg.norm(np.cross(eye, rotation[:, :, 2]), axis=1)
        assert across.max() < 0.15  # the axis passes the center within five deviations of the jitter
        fields.append(fov)
        elevations.append(np.arcsin(eye[:, 1] / np.linalg.norm(eye, axis=1)))
        distances.append(np.linalg.norm(eye, axis=1) * np.sin(fov / 2) / FRAME_RADIUS)
    degrees = np.degrees(np.concatenate(fields))
    assert degrees.min() >= 21.99 and degrees.max() <= 37.01
    assert abs(degrees.mean() - 29.5) < 0.4 and abs(degrees.std() - 3.4) < 0.3  # 1600 draws: five standard errors
    elevation = np.degrees(np.concatenate(elevations))
    assert ((elevation > -21.5) & (elevation < 56.5)).mean() > 0.9
    distance = np.concatenate(distances)
    assert distance.min() > 0.75 and distance.max() < 1.1  # 0.8 to 1.05 and the jitter of the target
