"""Views of a symmetric object as views of both halves: balls whose silhouettes and volume are closed forms."""

from dataclasses import fields, replace

import pytest
import torch
import trimesh

from reli3d.geometry.camera import Camera, camera_rays, look_at
from reli3d.geometry.rays import RayScene
from reli3d.geometry.visibility import MIN_COSINE
from reli3d.nn.local import PixelMaps, pixel_colors
from reli3d.nn.view_features import ViewMaps
from reli3d.nn.weights import load_model
from reli3d.pipeline import ReconstructOptions, Stopwatch, encode, reconstruct
from reli3d.prepare import completed, prepare
from reli3d.views.normalize import normalize
from reli3d.views.views import Views
from tests.support.meshes import mesh_from
from tests.support.reference_surface import grid

SIZE = 192
BALLS = [((0.0, 0.0, 0.0), 0.3), ((0.35, 0.1, 0.25), 0.14), ((-0.35, 0.1, 0.25), 0.14), ((0.0, 0.3, -0.2), 0.14)]
EYES = [(0.3, 0.9, 2.4), (2.3, 0.4, -0.8), (1.9, 1.2, 1.4), (0.2, -0.3, -2.2)]  # hardly any sees the left half


def depth_in_balls(points):
    """Positive inside the union, negative outside, ``(N,)``."""
    centers = torch.tensor([c for c, _ in BALLS])
    radii = torch.tensor([r for _, r in BALLS])
    return (radii - (points[:, None] - centers).norm(dim=-1)).amax(1)


@pytest.fixture(scope="module")
def views():
    c2w = torch.stack([look_at(eye) for eye in EYES])
    camera = Camera.from_fov(c2w, 0.6, SIZE, SIZE)
    origin, direction = camera_rays(camera)
    masks, images = [], []
    for o, d in zip(origin, direction):
        nearest, shade = torch.full((SIZE, SIZE), -1.0), torch.full((SIZE, SIZE), 0.5)
        for center, radius in BALLS:
            along = ((torch.tensor(center) - o) * d).sum(-1)
            away = (torch.tensor(center) - o - along[..., None] * d).norm(dim=-1)
            clear = (radius - away) * camera.intrinsics[0, 0] / along
            shade = torch.where(clear > nearest, 0.4 + 0.5 * (1 - away / radius).clamp(0, 1), shade)
            nearest = torch.maximum(nearest, clear)
        masks.append((nearest + 0.5).clamp(0, 1))
        images.append(shade[..., None] * torch.tensor([0.9, 0.5, 0.3]))
    return Views(tuple(images), tuple(masks), c2w, camera.intrinsics, tuple("abcd"))


def overlap(asset):
    """Intersection over union of mesh and balls on a grid; a point is inside where rays leave through the mesh."""
    points = grid(44, 0.55).reshape(-1, 3)
    scene = RayScene(asset.mesh.vertices, asset.mesh.faces)
    direction = torch.tensor([0.211, 0.943, 0.257]).expand_as(points).contiguous()
    hit = scene.closest(points, direction)
    corners = asset.mesh.vertices[asset.mesh.faces[hit.face.clamp(min=0).long()].long()]
    out = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    inside = (hit.face >= 0) & ((out * direction).sum(-1) > 0)
    true = depth_in_balls(points) > 0
    return float((inside & true).sum() / (inside | true).sum())


def test_the_other_half_comes_nearer_to_the_reference(views):
    found = {}
    for symmetry in ("off", "auto"):
        watch = Stopwatch(torch.device("cpu"))
        asset = reconstruct(views, options=ReconstructOptions(texture_size=256, symmetry=symmetry), watch=watch)
        found[symmetry] = overlap(asset)
        assert bool(watch.notes) == (symmetry == "auto")
    assert found["auto"] > found["off"] + 0.05


def test_mirror_images_determine_shape_and_base_color_but_not_the_lighting(views):
    model = load_model("small", "cpu")
    plain = prepare(model, views, normalize(views, "auto"))
    both = completed(plain)
    assert both.mirrored == 4 and len(both.batch) == len(both.images) == 8
    torch.testing.assert_close(both.batch.masks[4:], plain.batch.masks.flip(2))
    with torch.no_grad():
        one, two = encode(model, plain), encode(model, both)
        taken = PixelMaps(*(getattr(two.pixels, f.name)[:4] for f in fields(PixelMaps)))
        _, mask = pixel_colors(both.batch.images, both.batch.masks, both.batch.camera.resized(128, 128))
        light = model._light(taken, two.color[:4], mask[:4, ..., 0], both.batch.camera[:4].resized(128, 128))
    torch.testing.assert_close(two.log_light, light)
    assert two.maps.input_count == len(two.maps.inputs.images) == 4
    points = torch.tensor([[0.0, 0.0, 0.0], [0.1, 0.2, 0.1]])
    assert not torch.equal(one.sdf(points), two.sdf(points))


def test_a_mirror_image_shows_a_point_only_where_no_photograph_does():
    eyes = torch.tensor([[0.0, 0.0, 2.4], [2.4, 0.0, 0.0], [0.0, 0.0, -2.4], [0.3, 0.0, -2.4]])
    camera = Camera.from_fov(torch.stack([look_at(tuple(eye.tolist())) for eye in eyes]), 0.6, 8, 8)
    maps = ViewMaps(torch.zeros(4, 4, 4, 1), torch.zeros(4, 8, 8, 4), camera, mirrored=2)
    mesh = mesh_from(trimesh.creation.icosphere(subdivisions=4, radius=0.5))
    normal = mesh.vertices / mesh.vertices.norm(dim=1, keepdim=True)
    away = eyes - mesh.vertices[:, None]
    cosine = (away * normal[:, None]).sum(-1) / away.norm(dim=-1)  # from outside a ball hides what faces away
    visible = (cosine > 0.0).float()
    own, other = visible.split(2, 1)
    expected = torch.cat([own, other * (1.0 - own.amax(1, keepdim=True))], 1)
    sure = ((cosine - MIN_COSINE).abs() > 0.06).all(1)
    got = maps.visibility(RayScene(mesh.vertices, mesh.faces), mesh.vertices, normal)
    assert torch.equal(got[sure], expected[sure])
    assert bool(expected[sure, 2:].any()) and bool((visible[sure] != expected[sure]).any())
    assert torch.equal(maps.inputs.visibility(RayScene(mesh.vertices, mesh.faces), mesh.vertices, normal), got[:, :2])


def test_many_views_and_other_words_are_left_alone(views):
    with pytest.raises(ValueError, match="symmetry: expected auto, off, got yes"):
        ReconstructOptions(symmetry="yes")
    model = load_model("small", "cpu")
    many = views.select([0, 1, 2, 3, 0, 1, 2, 3, 0])
    prepared = prepare(model, many, normalize(many, "auto"))
    assert completed(prepared) is prepared


def test_rays_only_where_the_corners_of_a_face_differ():
    camera = Camera.from_fov(torch.stack([look_at((0.0, 0.0, 2.4)), look_at((2.4, 0.0, 0.0))]), 0.6, 8, 8)
    maps = ViewMaps(torch.zeros(2, 4, 4, 1), torch.zeros(2, 8, 8, 4), camera)
    mesh = mesh_from(trimesh.creation.icosphere(subdivisions=3, radius=0.5))
    scene, normal = RayScene(mesh.vertices, mesh.faces), mesh.vertices / 0.5
    at_vertices = maps.visibility(scene, mesh.vertices, normal)[mesh.faces.long()]  # (F, 3, V)
    barycentric = torch.tensor([0.2, 0.3, 0.5])
    corners = (at_vertices * barycentric[:, None]).sum(1)
    middle = (mesh.vertices[mesh.faces.long()] * barycentric[:, None]).sum(1)
    outward = middle / middle.norm(dim=1, keepdim=True)
    same = (at_vertices == at_vertices[:, :1]).all(1).all(1)
    assert 0.5 < float(same.float().mean()) < 0.95
    got, expected = maps.visibility_within(scene, middle, outward, corners), maps.visibility(scene, middle, outward)
    assert torch.equal(got[~same], expected[~same]) and torch.equal(got[same], at_vertices[same, 0])
    assert torch.equal(got, expected), "a ball has no shadow inside a face"
    none = RayScene(mesh.vertices + 9.0, mesh.faces)  # would hide nothing
    assert torch.equal(maps.visibility_within(none, middle[same], outward[same], corners[same]), got[same])
    same_corners = (at_vertices == at_vertices[:, :1]).all(1)  # of a view
    shell = RayScene(mesh.vertices * 1.5, mesh.faces)  # hides all
    assert not bool(maps.visibility(shell, middle, outward).any())
    assert torch.equal(
        maps.visibility_within(shell, middle, outward, corners), torch.where(same_corners, at_vertices[:, 0], 0.0)
    )
    assert bool((same_corners & ~same[:, None] & (at_vertices[:, 0] > 0)).any())
    half = replace(maps, mirrored=1)
    at_vertices = half.visibility(scene, mesh.vertices, normal)[mesh.faces.long()]
    corners = (at_vertices * barycentric[:, None]).sum(1)
    got = half.visibility_within(scene, middle, outward, corners)
    assert torch.equal(got, half.visibility(scene, middle, outward)) and 0.1 < float(got[:, 1].mean()) < 0.4
