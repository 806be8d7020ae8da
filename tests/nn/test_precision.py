"""The dtype that is left to the device."""

import pytest
import torch

from reli3d.nn.model import Reconstructor
from reli3d.nn.weights import load_model, save
from tests.support.networks import NANO


@pytest.mark.parametrize(
    "instructions, has",
    [
        ({"avx512_bf16": True}, True),
        ({"amx_bf16": True, "avx512_bf16": False}, True),
        ({"bf16": True}, True),
        ({"avx512_f": True, "avx512_bf16": False}, False),
        ({}, False),
    ],
)
def test_automatic_precision_is_bfloat16_where_the_processor_multiplies_it(tmp_path, monkeypatch, instructions, has):
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: instructions, raising=False)
    expected = torch.bfloat16 if has else torch.float32
    save(tmp_path / "nano.safetensors", Reconstructor(NANO), license="none")
    assert load_model(tmp_path / "nano.safetensors", trunk="auto").dtype == expected
    assert load_model("small", trunk="auto").dtype == expected
