"""Presets as data: each field with hostile values makes a network that runs, or is refused in one line naming it."""

import dataclasses
import functools
import json
import math
import tracemalloc

import pytest
import torch

from reli3d.geometry.camera import look_at
from reli3d.nn.model import Reconstructor
from reli3d.nn.presets import OFFICIAL, SMALL, LocalPreset, from_json, to_json
from reli3d.nn.weights import WeightsError, load, network, shapes, write
from tests.support import networks
from tests.support.networks import NANO, views

LOCAL = dataclasses.replace(networks.LOCAL, image_size=32)
HUGE = 1 << 40
HOSTILE = [0, 1, 2, 3, 7, -1, HUGE, 8192, 0.5, math.nan, math.inf, True, None, "8", [], [8], [0, 8, 8], [7, 17, 9], {}]
HOSTILE += [[8.0, 8, 8], [HUGE] * 3, [8] * 9, [8192, 8192, 8192], [1, 1, 1], [8, 8], [16, 24, 32]]


def paths(values: dict, at: tuple = ()):
    for name, value in values.items():
        yield (*at, name)
        if isinstance(value, dict):
            yield from paths(value, (*at, name))


def changed(preset, path: tuple, value) -> str:
    content = json.loads(to_json(preset))
    part = content
    for name in path[:-1]:
        part = part[name]
    part[path[-1]] = value
    return json.dumps(content)


@functools.cache
@torch.no_grad()
def run(preset) -> None:
    """A forward pass on tiny inputs; of a large network only its parameters, without memory for them."""
    if sum(math.prod(shape) for shape in shapes(preset).values()) > 1e6 or preset.image_size > 64:
        return
    torch.manual_seed(0)
    model, size = network(preset).eval(), preset.image_size
    images, masks, c2w, intrinsics = views(1, 2, size)
    if isinstance(model, Reconstructor):
        code = model.encode(images, masks, c2w, intrinsics)
        got = model.query(code, torch.rand(1, 5, 3) - 0.5)
        assert all(value.shape[:2] == (1, 5) for value in got.values())
        assert model.decode_environment(code).shape == (1, preset.reni.height, 2 * preset.reni.height, 3)
        return
    detail = torch.cat([images[0], 4.0 * masks[0, ..., None] - 2.0], -1)
    up = torch.tensor([0.0, 1.0, 0.0])
    c2w = look_at(torch.tensor([[0.0, 0.0, 2.0], [2.0, 0.0, 0.0]]), torch.zeros(2, 3), up)
    field = model.encode(images[0], masks[0], c2w, intrinsics[0].contiguous(), detail, intrinsics[0].contiguous())
    position, visible = torch.rand(5, 3) - 0.5, torch.ones(5, 2)
    normal = torch.nn.functional.normalize(position, dim=-1)
    assert field.sdf(position).shape == (5,)
    assert field.with_shading(position, normal, visible).material(position, normal, visible).base_color.shape == (5, 3)


CASES = [(preset, path) for preset in (LOCAL, NANO) for path in paths(json.loads(to_json(preset)))]


@pytest.mark.parametrize("preset, path", CASES, ids=[f"{p.name}.{'.'.join(path)}" for p, path in CASES])
def test_a_field_with_a_hostile_value_makes_a_network_or_is_named(preset, path):
    run(preset)
    refused = 0
    for value in HOSTILE:
        try:
            made = from_json(changed(preset, path, value))
        except ValueError as error:
            assert "preset" in str(error) and path[-1] in str(error) and "\n" not in str(error), (value, error)
            assert "got" in str(error) and len(str(error)) < 250
            refused += 1
        else:
            run(made)
    assert refused >= 4  # of any field: None and {} at least, a number or text for one that is neither


@pytest.mark.parametrize(
    "preset, path, value, message",
    [
        (LOCAL, ("view_width",), 7, r"preset.view_width: expected an integer from 10 to 8192, got 7"),
        (LOCAL, ("pyramid", "widths"), [], r"preset.pyramid.widths: expected 1 to 8 widths, .*, got \(\)"),
        (NANO, ("backbone", "groups"), 0, r"preset.backbone.groups: expected an integer from 1 to 8192, got 0"),
        (NANO, ("backbone", "heads"), 3, r"preset.backbone.heads: expected a divisor of encoder.hidden, 32, got 3"),
        (NANO, ("reni", "height"), 8192, r"preset.reni.height: expected an integer from 4 to 512, got 8192"),
        (NANO, ("backbone", "blocks"), 0, r"preset.backbone.blocks: expected an integer from 1 to 64, got 0"),
        (NANO, ("radius",), math.nan, r"preset.radius: expected a number from 0.001 to 1000, got nan"),
        (NANO, ("radius",), math.inf, r"preset.radius: expected a number from 0.001 to 1000, got inf"),
        (NANO, ("tone_mapping",), True, r"preset.tone_mapping: not a field of this version; convert .* again"),
        (LOCAL, ("image_size",), 36, r"preset.image_size: expected a multiple of 8, as there are levels .*, got 36"),
    ],
)
def test_a_file_with_an_impossible_preset_is_refused_before_any_tensor(tmp_path, preset, path, value, message):
    file = tmp_path / "a.safetensors"
    write(file, {"x": torch.zeros(1)}, {"format": "reli3d 1", "preset": changed(preset, path, value)})
    tracemalloc.start()
    with pytest.raises(WeightsError, match=message):
        load(file)
    assert tracemalloc.get_traced_memory()[1] < 1 << 24
    tracemalloc.stop()


def test_the_largest_maps_of_a_preset_allocate_nothing_before_shapes_are_compared():
    """512 rows of directions are 6 MiB; on the meta device there are none."""
    preset = dataclasses.replace(OFFICIAL, reni=dataclasses.replace(OFFICIAL.reni, height=512))
    with torch.device("meta"):
        assert network(preset).environment.sample_directions.is_meta
    assert isinstance(from_json(to_json(SMALL)), LocalPreset)


def test_a_preset_from_before_the_cost_volume_has_none():
    values = json.loads(to_json(SMALL))
    del values["cost_volume"]
    values["pyramid"]["material_bins"] = 1  # written by development versions after 0.3
    preset = from_json(json.dumps(values))
    assert preset == dataclasses.replace(SMALL, cost_volume=False)
    assert not any(name.startswith("cost_volume.") for name in shapes(preset))
    values["pyramid"]["material_bins"] = 8
    with pytest.raises(ValueError, match=r"preset\.pyramid\.material_bins: not a field of this version"):
        from_json(json.dumps(values))
