"""Surfaces with exchanged materials: a region gets its finish, and no placeholder of a scan survives."""

import functools

import numpy as np
import pytest
import torch
from PIL import Image

from reli3d.errors import InputError
from reli3d.render.color import srgb_to_linear
from reli3d.synthetic.refinished import MAX_ALBEDO, RefinishedSurface, material_sets
from reli3d.synthetic.samples import random_faces
from tests.support.surfaces import Ball

PLACEHOLDER = 0.8


def finish(position):
    """Red above and blue below, with the placeholders of a scan."""
    color = torch.where(position[:, 1:2] > 0, torch.tensor([0.6, 0.05, 0.05]), torch.tensor([0.05, 0.05, 0.6]))
    return color, torch.full((len(position),), PLACEHOLDER), torch.zeros(len(position))


@functools.cache
def ball():
    return Ball(finish, 3, 1.0)


@pytest.fixture
def sets(tmp_path):
    """One set of a single color, roughness 0.2 in 16 bits, metallic 1, flat."""
    folder = tmp_path / "sets" / "steel"
    folder.mkdir(parents=True)
    Image.new("RGB", (64, 64), (188, 188, 188)).save(folder / "basecolor.png")
    Image.fromarray(np.full((64, 64), 51 * 257, np.uint16)).save(folder / "roughness.png")
    Image.new("L", (64, 64), 255).save(folder / "metallic.png")
    return material_sets(tmp_path / "sets")


def refinished(sets, seed, *, measured):
    rng = np.random.default_rng(seed)
    surface = RefinishedSurface(ball(), sets, rng, measured=measured, texels=256)
    return surface.points_at(*random_faces(surface, 400, np.random.default_rng(0)))


def test_the_same_seed_gives_the_same_materials(sets):
    first, second, other = (refinished(sets, seed, measured=False) for seed in (5, 5, 6))
    for name in ("base_color", "roughness", "metallic", "normal"):
        assert torch.equal(getattr(first, name), getattr(second, name))
    assert not torch.equal(first.roughness, other.roughness)


def test_values_are_materials(sets):
    for seed in range(20):
        points = refinished(sets, seed, measured=bool(seed % 2))
        assert bool((points.base_color >= 0).all() and (points.base_color <= 1).all())
        assert bool((points.roughness >= 0.03).all() and (points.roughness <= 1).all())
        assert bool((points.metallic >= 0).all() and (points.metallic <= 1).all())
        torch.testing.assert_close(points.normal.norm(dim=-1), torch.ones(400), rtol=0, atol=1e-5)


def test_placeholders_of_a_scan_are_never_kept_and_measured_values_are(sets):
    kept = {measured: 0 for measured in (False, True)}
    for seed in range(30):
        for measured in kept:
            roughness = refinished(sets, seed, measured=measured).roughness
            kept[measured] += int((roughness == PLACEHOLDER).float().mean() > 0.05)
    assert kept[False] == 0
    assert kept[True] > 5  # a finish is kept with probability 0.32, and there are one to four


def test_a_set_of_one_color_gives_that_material(sets):
    """sRGB 188 is 0.503 linear; the gain of a channel is log-normal with a deviation of 0.21: within 0.4 to 2."""
    found = 0
    for seed in range(30):
        points = refinished(sets, seed, measured=False)
        steel = (points.metallic == 1.0) & ((points.roughness - 0.2).abs() < 0.2)  # the shift's deviation is 0.06
        gray = srgb_to_linear(torch.tensor(188 / 255))
        if int(steel.sum()) > 1:
            ratio = points.base_color[steel] / gray
            if bool((ratio.std(0) < 1e-4).all()):  # constant over the region, as the set is
                found += 1
                assert 0.4 < float(ratio.min()) < float(ratio.max()) + 1e-6 < 2.0
    assert found >= 2


def test_borders_are_sharp(sets):
    """A point takes the finish of one region: of a set and something else no mixtures appear."""
    mixed = 0
    for seed in range(20):
        metallic = refinished(sets, seed, measured=False).metallic
        mixed += int(((metallic > 0.02) & (metallic < 0.98)).float().mean() > 0.2)
    assert mixed <= 4  # layers of procedural materials may blend


def test_a_folder_without_sets_or_with_a_missing_map_is_refused(tmp_path, sets):
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match="expected folders with basecolor"):
        material_sets(tmp_path / "empty")
    (sets[0] / "metallic.png").unlink()
    with pytest.raises(InputError, match="metallic"):
        material_sets(sets[0].parent)


def test_two_objects_of_five_keep_their_base_color_up_to_a_factor(sets):
    base = ball().points_at(*random_faces(ball(), 400, np.random.default_rng(0))).base_color
    factors = []
    for seed in range(120):
        color = refinished(sets, seed, measured=True).base_color
        factor = torch.stack([(color / base)[base[:, k] < 0.1, k].mean() for k in range(3)])  # the dark half: no limit
        if torch.allclose(color, (base * factor).clamp(max=MAX_ALBEDO), atol=1e-6):
            factors.append(factor.log())
    assert 50 <= len(factors) <= 82  # 0.4, and a quarter of the rest; three standard deviations are 16
    changed = torch.stack([f for f in factors if float(f.abs().max()) > 1e-5])
    assert 0.12 < len(changed) / len(factors) < 0.48  # 0.3, three standard deviations of 66
    assert 0.2 < float(changed.mean(1).std()) < 0.45  # 0.31 within three standard errors of 20
    assert 0.06 < float((changed - changed.mean(1, keepdim=True)).std()) < 0.14  # 0.12 of which a third is in the mean
