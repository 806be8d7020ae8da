"""In which precision networks compute where the choice is left to the device."""

from __future__ import annotations

from collections.abc import Mapping

import torch

from reli3d.nn.presets import LocalPreset, Preset

CHOICES = ("float32", "bfloat16", "auto")
INSTRUCTIONS = ("avx512_bf16", "amx_bf16", "bf16")  # torch's names: AMD and Intel, Intel, ARM


def computes_bfloat16(device: torch.device | str) -> bool:
    """Whether ``device`` has instructions for products of bfloat16; without them such products take longer than those
    of float32.  A torch that does not tell what a CPU has counts as one without.
    """
    if torch.device(device).type == "cuda":
        return torch.cuda.is_bf16_supported(including_emulation=False)
    able: Mapping[str, bool] = getattr(torch.cpu, "get_capabilities", dict)()
    return any(able.get(name, False) for name in INSTRUCTIONS)


def fastest(device: torch.device | str) -> torch.dtype:
    """bfloat16 where the device has instructions for it, else float32."""
    return torch.bfloat16 if computes_bfloat16(device) else torch.float32


def heads_dtype(preset: Preset | LocalPreset, device: torch.device | str, choice: str) -> torch.dtype:
    """The dtype of a network's material heads for one of :data:`CHOICES`; ``auto`` is :func:`fastest`, and float32 for
    the network of convolutions, whose heads are small.

    Raises ValueError for another choice, and for bfloat16 where the network has no such heads.
    """
    if choice not in CHOICES:
        raise ValueError(f"heads: expected {', '.join(CHOICES)}, got {choice}")
    if choice == "bfloat16" and isinstance(preset, LocalPreset):
        raise ValueError("heads: expected float32 or auto for the network of convolutions, got bfloat16")
    if choice == "auto":
        return fastest(device) if isinstance(preset, Preset) else torch.float32
    return getattr(torch, choice)
