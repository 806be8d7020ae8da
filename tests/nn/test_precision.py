"""Precision that is left to the device, and what bfloat16 does to the material heads."""

import math

import pytest
import torch

from reli3d.nn.heads import Heads
from reli3d.nn.model import Reconstructor
from reli3d.nn.precision import computes_bfloat16, fastest, heads_dtype
from reli3d.nn.presets import OFFICIAL, SMALL
from reli3d.nn.weights import load_model, save
from tests.support.networks import NANO

MATERIAL = ("base_color", "roughness", "metallic", "normal")


@pytest.mark.parametrize(
    "able, has",
    [
        ({"avx512_bf16": True}, True),
        ({"amx_bf16": True, "avx512_bf16": False}, True),
        ({"bf16": True}, True),
        ({"avx512_f": True, "avx512_bf16": False}, False),
        ({}, False),
    ],
)
def test_automatic_precision_asks_what_the_processor_has(tmp_path, monkeypatch, able, has):
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: able, raising=False)
    wanted = torch.bfloat16 if has else torch.float32
    assert computes_bfloat16("cpu") == has
    assert fastest("cpu") == heads_dtype(OFFICIAL, "cpu", "auto") == wanted
    assert heads_dtype(SMALL, "cpu", "auto") == torch.float32
    save(tmp_path / "nano.safetensors", Reconstructor(NANO), licence="none")
    assert load_model(tmp_path / "nano.safetensors", trunk="auto").dtype == wanted
    assert load_model("small", trunk="auto").dtype == wanted


def test_heads_are_float32_unless_asked_and_refuse_what_does_not_exist():
    assert heads_dtype(OFFICIAL, "cpu", "float32") == torch.float32
    assert heads_dtype(OFFICIAL, "cpu", "bfloat16") == torch.bfloat16
    with pytest.raises(ValueError, match="heads: expected float32 or auto for the network of convolutions"):
        heads_dtype(SMALL, "cpu", "bfloat16")
    with pytest.raises(ValueError, match="heads: expected float32, bfloat16, auto, got half"):
        heads_dtype(OFFICIAL, "cpu", "half")


@torch.no_grad()
def test_material_in_bfloat16_stays_within_a_step_of_eight_bits(device):
    """Two or three layers with eight bits a number: the maps are stored with eight bits too."""
    torch.manual_seed(0)
    heads = Heads(120, 64).to(device).eval()
    for layer in heads.modules():  # so that outputs spread over their range
        if isinstance(layer, torch.nn.Linear):
            layer.weight.mul_(2.0)
    triplane = 1.5 * torch.randn(1, 3, 40, 64, 64, device=device)  # between texels: features of size 1
    points = torch.rand(1, 5000, 3, device=device) * 2.0 - 1.0
    full, low = heads.at(triplane, points, MATERIAL), heads.at(triplane, points, MATERIAL, torch.bfloat16)
    assert float(full["base_color"].std()) > 0.05
    for name in ("base_color", "roughness", "metallic"):
        assert low[name].dtype == torch.float32
        error = (low[name] - full[name]).square().mean().sqrt()
        assert 0.0 < float(error) < 0.5 / 255, name  # measured 0.0005 to 0.0009
    cosine = (low["normal"] * full["normal"]).sum(-1).clamp(-1, 1)
    assert math.degrees(float(torch.acos(cosine.double()).mean())) < 0.2
    again = heads.at(triplane, points, MATERIAL)
    assert all(torch.equal(again[name], full[name]) for name in MATERIAL)
