"""Grid and curvature weight: thick parts are smoothed, thin ones are kept and get finer cells."""

import math

import pytest
import torch
import trimesh

from reli3d.fit.input_images import InputImages
from reli3d.fit.shape import BAND_CELLS, THIN_WEIGHT, Grid, curvature_weight, start_grid
from reli3d.geometry.camera import Camera
from tests.support.meshes import mesh_from


def box(points, low, high):
    """Signed distance of a box, exact inside and over a face."""
    outside = torch.maximum(torch.tensor(low) - points, points - torch.tensor(high))
    return outside.clamp(min=0.0).norm(dim=-1) + outside.amax(-1).clamp(max=0.0)


def block_and_sheet():
    """A block 16 cells wide at x < 22 and a sheet 3 cells thick from it to x = 58, with a spacing of one cell."""
    axes = [torch.arange(float(n)) for n in (64, 32, 32)]
    points = torch.stack(torch.meshgrid(*axes, indexing="ij"), -1)
    sheet = box(points, [20.0, 8.0, 14.5], [58.0, 24.0, 17.5])
    return torch.minimum(box(points, [6.0, 8.0, 8.0], [22.0, 24.0, 24.0]), sheet)


def test_the_weight_is_1_in_thick_parts_small_in_thin_ones_and_0_elsewhere():
    sdf = block_and_sheet()
    weight = curvature_weight(sdf, sdf, 1.0)
    near = sdf.abs() < BAND_CELLS
    # the core ends at x = 18 and reaches 8 cells farther along each axis: all that is near the block
    assert (weight[:23][near[:23]] == 1.0).all()
    assert torch.allclose(weight[28:][near[28:]], torch.tensor(THIN_WEIGHT))
    assert (weight[~near] == 0.0).all()


def test_a_bound_that_leaves_a_thin_part_makes_it_thin():
    sdf = block_and_sheet()
    axis = torch.arange(32.0)[None, None, :]
    bound = ((axis - 16.0).abs() - 1.5).expand_as(sdf)  # silhouettes allow three cells of the block
    weight = curvature_weight(sdf, bound, 1.0)
    assert torch.allclose(weight[sdf.abs() < BAND_CELLS], torch.tensor(THIN_WEIGHT))


def slab(depth):
    return mesh_from(trimesh.creation.box((1.8, 2.0, depth)))


def unbounded():
    """An image from far away whose mask excludes nothing."""
    c2w = torch.eye(4)
    c2w[2, 3] = 10.0
    camera = Camera(c2w[None], torch.tensor([[32.0, 32.0, 16.0, 16.0]]), 32, 32)
    return InputImages(torch.ones(1, 32, 32, 3), torch.ones(1, 32, 32), camera)


@pytest.mark.parametrize("depth, finer", [(1.6, 1.0), (0.12, 2.0)])
def test_thin_objects_get_a_finer_grid(depth, finer):
    grid, sdf, bound = start_grid(slab(depth), unbounded(), 32)
    assert grid.cell == pytest.approx(2.0 / 32 / finer)
    assert sdf.shape == bound.shape == grid.shape


def test_a_finer_grid_has_at_most_so_many_points(monkeypatch):
    mesh = slab(0.12)
    points = math.prod(Grid.around(mesh.vertices, 32).shape)
    for most, cells in ((3.375 * points, 48), (points, 32)):
        monkeypatch.setattr("reli3d.fit.shape.MAX_GRID_POINTS", most)
        assert start_grid(mesh, unbounded(), 32)[0].cell == pytest.approx(2.0 / cells)
