"""What a reconstruction gives and a renderer takes: a mesh, its textures and a light."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from torch import Tensor

from reli3d._bridge import check

if TYPE_CHECKING:
    from reli3d.geometry.mesh import Mesh
    from reli3d.render.environment import Environment


@dataclass(frozen=True)
class TextureSet:
    """Square maps of one size, values in [0, 1]; row 0 is v = 0 (glTF: v down), texel centres at +0.5.

    base_color: ``(T, T, 3)``, sRGB-encoded.  orm: ``(T, T, 3)``, linear: 1 (no occlusion is baked), perceptual
    roughness, metallic.  normal: ``(T, T, 3)``, linear, tangent-space unit normal as
    ``n * 0.5 + 0.5``, green along the bitangent.
    """

    base_color: Tensor
    orm: Tensor
    normal: Tensor

    def __post_init__(self):
        for name in ("base_color", "orm", "normal"):
            value = getattr(self, name)
            check(name, value, last=3, like=self.base_color)
            if value.ndim != 3 or value.shape[0] != value.shape[1] or value.shape != self.base_color.shape:
                raise ValueError(f"{name}: expected (T, T, 3) like base_color {tuple(self.base_color.shape)}, "
                                 f"got {tuple(value.shape)}")  # fmt: skip

    @property
    def size(self) -> int:
        """Texels along a side."""
        return self.base_color.shape[0]


@dataclass(frozen=True)
class Asset:
    """A relightable object.  ``environment`` is the light it was captured under, where that is known."""

    mesh: Mesh
    textures: TextureSet
    environment: Environment | None = None
