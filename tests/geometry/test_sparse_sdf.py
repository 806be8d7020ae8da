"""Sparse evaluation of a signed field against a dense one."""

import pytest
import torch

from reli3d.geometry.sparse_sdf import INSIDE_DEPTH, sparse_sdf
from reli3d.geometry.surface import extract_surface
from tests.support.reference_surface import grid


def lumps(points):
    """A ball with waves on it and a rod through it, two points wide."""
    ball = (points.norm(dim=-1) - 0.6 - 0.05 * (9.0 * points).sin().prod(-1)) / 0.05
    rod = (points[..., :2].norm(dim=-1) - 0.03) / 0.05
    return torch.minimum(ball, rod)


def sparse(sdf, near, known=None):
    evaluated = []

    def evaluate(index):
        evaluated.append(index)
        return sdf.view(-1)[index]

    got = sparse_sdf(torch.full_like(sdf, 9.0) if known is None else known, near, evaluate)
    return got, torch.cat(evaluated)


@pytest.mark.parametrize("count", [49, 56])  # with and without a last point outside all coarse cells
def test_same_surface_to_the_bit_from_fewer_points(count):
    sdf = lumps(grid(count - 1))
    near = sdf < 2.0
    got, evaluated = sparse(sdf, near)
    assert len(evaluated) == len(evaluated.unique()), "a point is evaluated once"
    assert len(evaluated) < 0.75 * int(near.sum())
    shallow = near & (got != -INSIDE_DEPTH)
    assert torch.equal(got[shallow], sdf[shallow]) and bool((got[~near] == 9.0).all())
    assert bool((sdf[~shallow & near] < 0.0).all())
    expected = extract_surface(torch.where(near, sdf, 9.0), radius=1.0)
    mesh = extract_surface(got, radius=1.0)
    assert torch.equal(mesh.vertices, expected.vertices) and torch.equal(mesh.faces, expected.faces)


def test_a_surface_that_leaves_the_region_is_followed():
    sdf = (grid(32)[..., 2].abs() - 0.5) / 0.05  # a slab, of which the region has a column
    near = torch.zeros_like(sdf, dtype=torch.bool)
    near[14:19, 14:19] = True
    got, _ = sparse(sdf, near)
    for axis in range(3):
        before, after = (got.narrow(axis, k, 32) < 0 for k in (0, 1))
        for k in (0, 1):
            ends = before != after
            assert torch.equal(got.narrow(axis, k, 32)[ends], sdf.narrow(axis, k, 32)[ends])


@pytest.mark.parametrize(("depth", "found"), [(0.9 * INSIDE_DEPTH, True), (1.1 * INSIDE_DEPTH, False)])
def test_a_cavity_between_coarse_points_is_found_where_they_are_shallow(depth, found):
    sdf = torch.full((9, 9, 9), -depth)
    sdf[3, 3, 3] = 1.0
    got, _ = sparse(sdf, torch.ones(9, 9, 9, dtype=torch.bool))
    assert bool(got[3, 3, 3] > 0) == found


def test_known_values_outside_the_region_are_kept():
    known = torch.full((9, 9, 9), -5.0)
    got, evaluated = sparse(known, torch.zeros(9, 9, 9, dtype=torch.bool), known=known)
    assert len(evaluated) == 0 and torch.equal(got, known)


def test_wrong_grids_are_named():
    with pytest.raises(ValueError, match=r"known, near: expected one shape \(X, Y, Z\) of 3 or more, got"):
        sparse(torch.zeros(2, 9, 9), torch.ones(2, 9, 9, dtype=torch.bool))
    with pytest.raises(TypeError, match="near: expected torch.bool"):
        sparse(torch.zeros(9, 9, 9), torch.ones(9, 9, 9))


def test_a_permuted_grid_has_the_same_values():
    sdf = lumps(grid(24))
    near = sdf < 2.0
    turned = sdf.permute(2, 1, 0)
    got = sparse_sdf(torch.full_like(sdf, 9.0).permute(2, 1, 0), near.permute(2, 1, 0), lambda k: turned.reshape(-1)[k])
    assert torch.equal(got, sparse(turned.contiguous(), near.permute(2, 1, 0).contiguous())[0])
