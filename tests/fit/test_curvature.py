"""The surface's grid and the curvature's share: thick parts are smoothed, thin ones are kept and get finer cells."""

import math

import pytest
import torch
import trimesh

from reli3d.fit import losses
from reli3d.fit.photographs import Photographs
from reli3d.fit.shape import BAND, THIN, Grid, curvature_share, start_grid
from reli3d.geometry.camera import Camera
from reli3d.geometry.mesh import Mesh


def box(points, low, high):
    """Signed distance of a box, exact inside and beside a face."""
    outside = torch.maximum(torch.tensor(low) - points, points - torch.tensor(high))
    return outside.clamp(min=0.0).norm(dim=-1) + outside.amax(-1).clamp(max=0.0)


def block_and_sheet():
    """A block 16 cells wide at x < 22 and a sheet 3 cells thick from it to x = 58, on points one cell apart."""
    axes = [torch.arange(float(n)) for n in (64, 32, 32)]
    points = torch.stack(torch.meshgrid(*axes, indexing="ij"), -1)
    sheet = box(points, [20.0, 8.0, 14.5], [58.0, 24.0, 17.5])
    return torch.minimum(box(points, [6.0, 8.0, 8.0], [22.0, 24.0, 24.0]), sheet)


def test_thick_parts_count_in_full_thin_ones_little_and_the_rest_not():
    level = block_and_sheet()
    share = curvature_share(level, level, 1.0)
    near = level.abs() < BAND
    # the core ends at x = 18 and reaches 8 cells farther along each axis: all that is near the block
    assert (share[:23][near[:23]] == 1.0).all()
    assert torch.allclose(share[28:][near[28:]], torch.tensor(THIN))
    assert (share[~near] == 0.0).all()


def test_a_bound_that_leaves_a_thin_part_makes_it_thin():
    level = block_and_sheet()
    axis = torch.arange(32.0)[None, None, :]
    bound = ((axis - 16.0).abs() - 1.5).expand_as(level)  # silhouettes allow three cells of the block
    share = curvature_share(level, bound, 1.0)
    assert torch.allclose(share[level.abs() < BAND], torch.tensor(THIN))


def test_descent_of_the_curvature_keeps_a_thin_sheet():
    """Steps of the term alone: without the share the ridge in the sheet sinks and opens it."""
    for held in (True, False):
        first = block_and_sheet()
        near = (first.abs() < BAND).float()
        share = curvature_share(first, first, 1.0) if held else near
        level = first.clone().requires_grad_(True)
        for _ in range(1000):
            (slope,) = torch.autograd.grad(losses.curvature(level, 1.0, share), level)
            with torch.no_grad():
                level -= 0.006 * slope  # stable below 1 / 12**2
        inside = level.detach()[32:54, 10:22, 16]
        assert bool((inside < 0.0).all()) is held


def slab(depth):
    box = trimesh.creation.box((1.8, 2.0, depth))
    return Mesh(torch.tensor(box.vertices).float(), torch.tensor(box.faces).int())


def unbounded():
    """A photograph, from far away, whose mask excludes nothing."""
    c2w = torch.eye(4)
    c2w[2, 3] = 10.0
    camera = Camera(c2w[None], torch.tensor([[32.0, 32.0, 16.0, 16.0]]), 32, 32)
    return Photographs(torch.ones(1, 32, 32, 3), torch.ones(1, 32, 32), camera)


@pytest.mark.parametrize("depth, finer", [(1.6, 1.0), (0.12, 2.0)])
def test_thin_objects_get_a_finer_grid(depth, finer):
    grid, level, bound = start_grid(slab(depth), unbounded(), 32)
    assert grid.cell == pytest.approx(2.0 / 32 / finer)
    assert level.shape == bound.shape == grid.shape


def test_a_finer_grid_has_at_most_so_many_points(monkeypatch):
    mesh = slab(0.12)
    points = math.prod(Grid.around(mesh.vertices, 32).shape)
    for most, cells in ((3.375 * points, 48), (points, 32)):
        monkeypatch.setattr("reli3d.fit.shape.LARGEST", most)
        assert start_grid(mesh, unbounded(), 32)[0].cell == pytest.approx(2.0 / cells)
