"""Surface points with their material."""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from numbers import Real
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from reli3d._bridge import Movable, check, mapped, tensor_of

UNIT_TOLERANCE = 1e-4  # of a length from 1: float32 interpolation and rotation err by 1e-6
SCALAR_VALUES = ("base_color", "roughness", "metallic")  # may be a plain number: gray, or the same everywhere


@dataclass(frozen=True)
class SurfacePoints(Movable):
    """Geometry and material of N surface points, float32, world frame.

    position: ``(N, 3)``.  ng: ``(N, 3)`` geometric normal, unit, outward.  normal: ``(N, 3)`` shading normal, unit.
    base_color: ``(N, 3)`` linear, in [0, 1].  roughness: ``(N,)`` perceptual, in [0, 1].  metallic: ``(N,)`` in [0, 1].
    All but ``position`` may be a single row for all points, and base_color, roughness and metallic also a single
    number; after construction all fields have N rows.  Gradients pass through.  Raises TypeError for a wrong type or
    dtype, ValueError for a wrong shape or device.

    >>> points = reli3d.SurfacePoints(position, normal, normal, base_color=0.8, roughness=0.4, metallic=0.0)
    >>> radiance = reli3d.shade(points, wo, light)
    """

    position: Tensor
    ng: Tensor
    normal: Tensor
    base_color: Tensor
    roughness: Tensor
    metallic: Tensor

    if TYPE_CHECKING:  # types that the constructor accepts

        def __init__(
            self,
            position: Tensor,
            ng: Tensor,
            normal: Tensor,
            base_color: Tensor | float,
            roughness: Tensor | float,
            metallic: Tensor | float,
        ) -> None: ...

    def __post_init__(self):
        object.__setattr__(self, "position", tensor_of(self.position))
        check("position", self.position, shape=("N", 3))
        for name, last in (("ng", 3), ("normal", 3), ("base_color", 3), ("roughness", 0), ("metallic", 0)):
            object.__setattr__(self, name, of_rows(name, getattr(self, name), self.position, last))

    def __len__(self) -> int:
        return len(self.position)

    def __getitem__(self, rows: Tensor | slice) -> "SurfacePoints":
        """The points of ``rows``: a slice, indices or a mask."""
        return mapped(self, lambda values: values[rows])


@torch.no_grad()
def nan_where_not_finite(values: Sequence[Tensor]) -> Tensor:
    """``(N, 1)``: 0, or NaN if any of ``values (N, 3)`` or ``(N,)`` is non-finite, which a minimum would hide."""
    rows = torch.zeros_like(values[0])
    for value in values:
        rows += (value if value.ndim == 2 else value[:, None]) * 0.0
    return (rows[:, 0] + rows[:, 1] + rows[:, 2])[:, None]  # a sum over columns would take 5 times as long


def check_values(points: SurfacePoints, wo: Tensor) -> None:
    """Raise ValueError for unnormalized directions, materials outside [0, 1] and non-finite values."""
    given = {f.name: getattr(points, f.name).detach() for f in fields(points)} | {"wo": wo.detach()}
    for name, value in given.items():
        if name in SCALAR_VALUES:
            bad, expected = ~((value >= 0.0) & (value <= 1.0)), "values in [0, 1]"
        elif name == "position":
            bad, expected = ~torch.isfinite(value), "finite values"
        else:
            bad, expected = ~((value.norm(dim=1) - 1.0).abs() <= UNIT_TOLERANCE), "unit vectors"
        rows = bad.reshape(len(value), -1).any(1).nonzero()
        if len(rows):
            raise ValueError(f"{name}: expected {expected}, got {value[rows[0, 0]].tolist()} in row {int(rows[0, 0])}")


def of_rows(name: str, value: Tensor | float, position: Tensor, last: int) -> Tensor:
    """``value`` as ``(N, last)``, or ``(N,)`` if ``last`` is 0, for N rows of ``position``; one row is repeated."""
    shape = (len(position), last) if last else (len(position),)
    if isinstance(value, Real) and name in SCALAR_VALUES:
        return position.new_tensor(float(value)).expand(shape)
    rows: Tensor = tensor_of(value)
    check(name, rows, like=position)
    if name in SCALAR_VALUES and rows.numel() == 1:
        return rows.reshape(()).expand(shape)
    check(name, rows, last=last or None)
    if rows.shape == shape:
        return rows
    if rows.numel() != max(last, 1):
        raise ValueError(f"{name}: expected shape {shape} or one row, got {tuple(rows.shape)}")
    return rows.reshape(shape[1:]).expand(shape)
