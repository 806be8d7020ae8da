"""The pixels that a fit of maps shades: a uniform sample where there are more than the limit."""

import torch
from torch.nn.functional import one_hot

from reli3d.fit import maps
from reli3d.fit.input_images import InputImages
from reli3d.fit.unknowns import Start
from reli3d.geometry.rays import RayScene
from tests.support import small_scene


def test_of_more_pixels_than_the_limit_a_uniform_sample_is_kept(monkeypatch):
    asset, images = small_scene.ball(), InputImages.of(small_scene.input_views(small_scene.ball(), 3, 64))
    none = torch.zeros_like(asset.mesh.vertices)
    data = maps.FixedSurface(Start.of(asset), asset, none, images, [0, 2])
    scene = RayScene(asset.mesh.vertices, asset.mesh.faces)
    every = maps.traced(data, scene, seed=0)
    monkeypatch.setattr(maps, "MAX_PIXELS", 400)
    few = maps.traced(data, scene, seed=0)
    assert len(few.order) == 400 < len(every.order) and set(few.view.tolist()) == {0, 2}
    rows, all_rows = ({tuple(row) for row in torch.cat([p.position, p.target], 1).tolist()} for p in (few, every))
    assert len(rows) == 400 and rows <= all_rows
    columns, all_columns = (torch.cat([p.position, one_hot(p.view)[:, 2:]], 1) for p in (few, every))
    deviation = (columns.mean(0) - all_columns.mean(0)) / (all_columns.std(0) / 400**0.5)
    assert float(deviation.abs().max()) < 4.0  # probability 3e-4 for four normal variables
