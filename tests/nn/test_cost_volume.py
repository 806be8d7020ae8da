"""The cost volume finds the depth of a textured sphere, known in closed form, by correlation alone."""

import pytest
import torch
from torch import Tensor
from torch.nn import functional

from reli3d.geometry.camera import Camera, camera_rays, look_at
from reli3d.nn.cost_volume import OFFSETS, CostVolume
from reli3d.nn.pyramid import depth_of_origin
from reli3d.synthetic.procedural import yaw_matrix
from tests.support.differences import directional_derivatives

SIDE, RADIUS, DISTANCE = 48, 0.4, 2.0


def texture(points: Tensor) -> Tensor:
    """Pseudorandom colors ``(..., 3)`` of points in space: sums of waves of length 0.3 and more."""
    waves = torch.randn(3, 24, generator=torch.Generator().manual_seed(0)) * 14.0
    return (points @ waves + torch.arange(24.0)).sin().unflatten(-1, (3, 8)).mean(-1) + 0.5


def sphere_views(count: int, turn: float = 0.0) -> dict:
    """Views around a sphere at the origin, with depths in closed form and a texture that turns with them."""
    azimuth = torch.arange(count) * 0.3
    eye = DISTANCE * torch.stack([azimuth.sin(), torch.full_like(azimuth, 0.2), azimuth.cos()], -1)
    c2w = torch.stack([look_at(e) for e in eye])
    camera = Camera(c2w, torch.tensor([2.0 * SIDE, 2.0 * SIDE, SIDE / 2, SIDE / 2]).expand(count, 4), SIDE, SIDE)
    origins, directions = camera_rays(camera)
    along = -(origins * directions).sum(-1)
    below = RADIUS**2 - (origins.square().sum(-1) - along.square())
    points = origins + (along - below.clamp(min=0).sqrt())[..., None] * directions
    seen = (below > 0).float()
    depth = -torch.einsum("vxyi,vi->vxy", points - c2w[:, None, None, :3, 3], c2w[:, :3, 2])
    depth = (depth - depth_of_origin(c2w)[:, None, None]) * seen
    world = torch.eye(4)
    world[:3, :3] = torch.from_numpy(yaw_matrix(turn))
    camera = Camera(world @ c2w, camera.intrinsics, SIDE, SIDE)
    normal = points / RADIUS @ world[:3, :3].T
    return {"camera": camera, "seen": seen, "truth": depth, "normal": normal, "color": texture(points)}


@pytest.fixture
def model() -> CostVolume:
    """Scores are 40 times the sum of the correlations of random features, without 3D neighborhood and prior."""
    torch.manual_seed(1)
    volume = CostVolume(4)
    with torch.no_grad():
        for layer in (volume.match[0], volume.match[2]):
            layer.weight.normal_()
            layer.bias.zero_()
        for value in (*volume.pair.parameters(), *volume.regular.parameters(), volume.prior):
            value.zero_()
        volume.pair[0].weight[0, :4] = 1.0
        volume.pair[0].bias[0] = 20.0  # far in the linear part of SiLU
        volume.pair[2].weight[0, 0] = 1.0
        for layer, gain in zip(volume.regular[::2], (40.0, 1.0, 1.0), strict=True):
            layer.weight[0, 0, 1, 1, 1] = gain
    return volume


def distribution(model: CostVolume, views: dict, predicted: Tensor) -> tuple[Tensor, Tensor]:
    features, span = torch.zeros(*predicted.shape, 4), torch.tensor([-0.5, 0.5]).expand(*predicted.shape, 2)
    args = (features, views["color"], predicted, views["normal"], span, views["camera"], views["seen"])
    return model(*args)


def found(model: CostVolume, views: dict, predicted: Tensor) -> Tensor:
    return distribution(model, views, predicted)[0]


def inner(views: dict) -> Tensor:
    """Pixels whose surroundings are inside the sphere's image."""
    return -functional.max_pool2d(-views["seen"][:, None], 7, 1, 3)[:, 0] > 0.5


@pytest.mark.parametrize("error", [-0.096, 0.048])
def test_a_wrong_depth_of_a_textured_sphere_is_corrected(model, error):
    views = sphere_views(5)
    with torch.no_grad():
        got = found(model, views, views["truth"] + error * views["seen"])
    left = (got - views["truth"]).abs()[inner(views)]
    assert error in OFFSETS  # a hypothesis is true
    assert float(left.median()) < 0.02  # width of a pixel


def test_the_standard_deviation_is_small_where_texture_shows_the_depth(model):
    views = sphere_views(5)
    gray = {**views, "color": torch.full_like(views["color"], 0.5)}
    with torch.no_grad():
        (_, sure), (_, unsure) = (distribution(model, v, v["truth"]) for v in (views, gray))
        _, initial = distribution(CostVolume(4), views, views["truth"])
    assert float(sure[inner(views)].median()) < 0.02  # width of a pixel
    assert float(unsure[inner(views)].median()) > 0.06
    weight = (-torch.tensor(OFFSETS).abs() / 0.06).softmax(0)
    expected = (weight * torch.tensor(OFFSETS).square()).sum().sqrt()
    torch.testing.assert_close(initial[inner(views)].mean(), expected, rtol=1e-3, atol=0)
    assert (sure[views["seen"] == 0] == 0).all()


@pytest.fixture
def random_model() -> CostVolume:
    """Every path contributes."""
    torch.manual_seed(2)
    volume = CostVolume(4)
    with torch.no_grad():
        for parameter in volume.parameters():
            parameter += 0.2 * torch.randn_like(parameter)
    return volume


def test_depths_do_not_depend_on_the_order_of_views_and_on_the_world_axes(random_model):
    views, turned = sphere_views(4), sphere_views(4, turn=1.0)
    order, predicted = torch.tensor([2, 0, 3, 1]), views["truth"] + 0.05 * torch.randn(4, SIDE, SIDE)
    exchanged = {name: value[order] for name, value in views.items()}
    with torch.no_grad():
        want = found(random_model, views, predicted)
        torch.testing.assert_close(found(random_model, exchanged, predicted[order]), want[order], rtol=0, atol=1e-5)
        torch.testing.assert_close(found(random_model, turned, predicted), want, rtol=0, atol=1e-4)  # float32 rotation
    assert (want - predicted)[inner(views)].abs().mean() > 1e-3


def test_at_initialization_and_outside_the_object_depths_are_those_predicted(random_model):
    views = sphere_views(3)
    predicted = 0.1 + 0.1 * torch.rand(3, SIDE, SIDE)
    with torch.no_grad():
        torch.testing.assert_close(found(CostVolume(4), views, predicted), predicted, rtol=0, atol=1e-6)
        got = found(random_model, views, predicted)
    assert (got == predicted)[views["seen"] == 0].all()
    assert (got != predicted)[inner(views)].float().mean() > 0.9


def test_gradients_reach_inputs_and_parameters(random_model):
    model, views = random_model, sphere_views(3)
    inputs = {name: views[name].clone().requires_grad_() for name in ("color", "normal")}

    def loss(views: dict) -> Tensor:
        return (found(model, views, views["truth"]) - views["truth"]).square().sum()

    loss({**views, **inputs}).backward()
    weight = model.match[2].weight
    direction = torch.zeros_like(weight)
    direction.view(-1)[weight.grad.abs().argmax()] = 1.0
    got, expected = directional_derivatives(lambda: loss(views), [weight], [direction], 1e-2)
    assert got == pytest.approx(expected, rel=0.05)  # a central difference of a float32 sum over some thousand pixels
    without = {id(model.regular[4].bias), id(model.widening)}  # the bias shifts all scores
    assert all(t.grad.abs().sum() > 0 for t in (*inputs.values(), *model.parameters()) if id(t) not in without)
