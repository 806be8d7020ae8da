"""Color transforms: sRGB encoding and decoding, and the AgX display transform.  Linear values are Rec. 709."""

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from reli3d._bridge import full_precision

# AgX with Rec. 709 primaries as ReLi3D was trained with: rows of the inset matrix and its inverse
_AGX_IN = (
    (0.842479062253094, 0.0784335999999992, 0.0792237451477643),
    (0.0423282422610123, 0.878468636469772, 0.0791661274605434),
    (0.0423756549057051, 0.0784336, 0.879142973793104),
)
_AGX_OUT = (
    (1.19687900512017, -0.0980208811401368, -0.0990297440797205),
    (-0.0528968517574562, 1.15190312990417, -0.0989611768448433),
    (-0.0529716355144438, -0.0980434501171241, 1.15107367264116),
)
_REC709 = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290)  # x, y of red, green, blue and white (D65)
_BRADFORD = ((0.8951, 0.2664, -0.1614), (-0.7502, 1.7135, 0.0367), (0.0389, -0.0685, 1.0296))  # XYZ to cone responses
_AGX_EV = (-12.47393, 4.026069)  # log2 range mapped to [0, 1]


def srgb_to_linear(value: Tensor) -> Tensor:
    """Linear values of sRGB-encoded ``value``, any shape.

    Not clamped: values above 1 follow the power law, negative values the linear toe, which ends at 0.04045.  Gradients
    everywhere.  Source: IEC 61966-2-1.

    >>> base_color = reli3d.srgb_to_linear(torch.full((64, 64, 3), 0.5))
    >>> textures = reli3d.TextureSet(base_color, roughness=0.5, metallic=0.0)
    """
    # the clamp keeps a NaN derivative out of the unused branch
    power = ((value.clamp(min=0.04045) + 0.055) / 1.055) ** 2.4
    return torch.where(value <= 0.04045, value / 12.92, power)


def linear_to_srgb(value: Tensor) -> Tensor:
    """sRGB encoding of linear values, any shape; inverse of :func:`srgb_to_linear`, not clamped.

    Gradients everywhere.  Source: IEC 61966-2-1.

    >>> encoded = reli3d.linear_to_srgb(torch.tensor([0.0, 0.18, 1.0]))
    >>> pixels = (255 * encoded).round().byte()
    """
    power = 1.055 * value.clamp(min=0.0031308) ** (1.0 / 2.4) - 0.055
    return torch.where(value <= 0.0031308, value * 12.92, power)


@full_precision
def agx(radiance: Tensor) -> Tensor:
    """sRGB-encoded display values in [0, 1] of linear radiance ``(..., 3)``: AgX, default look.

    Inset matrix, log2 between -12.47 and 4.03 stops, sigmoid contrast, outset matrix, power 2.2, then the sRGB
    transfer.  Gradients reach ``radiance`` and are exactly 0 where a value is clamped.  Source: AgX (T. Sobotka) with
    the constants of ReLi3D's display transform.
    """
    if radiance.ndim == 0 or radiance.shape[-1] != 3:
        raise ValueError(f"radiance: expected shape (..., 3), got {tuple(radiance.shape)}")
    low, high = _AGX_EV
    inset = radiance @ radiance.new_tensor(_AGX_IN).T
    stops = torch.log2(inset.clamp(min=0.0) + 1e-8).clamp(low, high)
    x = (stops - low) / (high - low)
    curve = (-0.01 + 1.053 / (1.0 + torch.exp(-8.1282 * (x - 0.6152)))).clamp(min=0.0)
    linear = (curve @ radiance.new_tensor(_AGX_OUT).T).clamp(0.0, 1.0) ** 2.2
    return linear_to_srgb(linear)


def rec709_from_primaries(primaries: Sequence[float]) -> np.ndarray | None:
    """Matrix ``(3, 3)`` float64 from linear RGB in other primaries to Rec. 709; None if the primaries are Rec. 709's.

    primaries: CIE 1931 x, y of red, green, blue and white, eight numbers; differences up to 1e-3 are ignored.  White is
    adapted by the Bradford transform (Lam 1985), so equal RGB stays equal.  Raises ValueError unless the primaries span
    a color space with positive white.
    """
    xy = np.array(primaries, np.float64)
    if xy.shape != (8,) or not np.isfinite(xy).all() or np.abs(xy).max() > 10.0:
        raise ValueError(f"primaries: expected eight numbers, got {primaries}")
    if np.abs(xy - _REC709).max() <= 1e-3:
        return None
    (source, white), (target, d65) = _xyz_from_rgb(xy), _xyz_from_rgb(np.array(_REC709))
    cones = np.array(_BRADFORD)
    adapted = np.linalg.inv(cones) @ np.diag((cones @ d65) / (cones @ white)) @ cones
    return np.linalg.inv(target) @ adapted @ source


def _xyz_from_rgb(xy: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Matrix from RGB to XYZ and the XYZ of white at Y = 1 (SMPTE RP 177)."""
    x, y = xy[0::2], xy[1::2]
    columns = np.stack([x, y, 1.0 - x - y])[:, :3]
    if abs(np.linalg.det(columns)) < 1e-4 or y[3] < 1e-2:
        raise ValueError(f"primaries: expected a triangle and a white, got {xy.tolist()}")
    white = np.array([x[3], y[3], 1.0 - x[3] - y[3]]) / y[3]
    scale = np.linalg.solve(columns, white)
    if not (scale > 0.0).all():
        raise ValueError(f"primaries: expected white within their triangle, got {xy.tolist()}")
    return columns * scale, white
