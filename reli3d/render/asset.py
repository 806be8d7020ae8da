"""Assets: a mesh with textures and an environment."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from torch import Tensor

from reli3d._bridge import Movable, check, expect, present, tensor_of
from reli3d.geometry.mesh import Mesh
from reli3d.render.environment import Environment

FLAT = (0.5, 0.5, 1.0)  # texel of a normal map without perturbation
WRAPS = ("repeat", "mirror", "clamp")  # glTF's REPEAT, MIRRORED_REPEAT, CLAMP_TO_EDGE


@dataclass(frozen=True, repr=False)
class TextureSet(Movable):
    """Metallic-roughness textures of one mesh: square float32 maps of equal size, with values in [0, 1].

    Row 0 is v = 0 (glTF: v down), texel centers at +0.5, bilinear lookup without mipmaps.  base_color: ``(T, T, 3)``,
    linear.  roughness (perceptual), metallic: ``(T, T)``, ``(T, T, 1)``, or a Python number.  normal: ``(T, T, 3)``,
    tangent-space normals as ``n / 2 + 0.5``, green along the bitangent; None: flat.  wrap: along u and v, each
    ``repeat``, ``mirror`` or ``clamp``.

    Gradients pass through.  Raises TypeError for a wrong type or dtype, ValueError for a wrong shape, device or wrap
    mode.  Only writers check ranges: clamp optimized maps.

    >>> textures = reli3d.TextureSet(torch.full((64, 64, 3), 0.5), roughness=0.4, metallic=0.0)
    >>> asset = reli3d.Asset(mesh, textures)
    """

    base_color: Tensor
    roughness: Tensor
    metallic: Tensor
    normal: Tensor = None  # type: ignore[assignment] # flat after construction
    wrap: tuple[str, str] = ("repeat", "repeat")

    if TYPE_CHECKING:  # types that the constructor accepts

        def __init__(
            self,
            base_color: Tensor,
            roughness: Tensor | float,
            metallic: Tensor | float,
            normal: Tensor | None = None,
            wrap: Any = ("repeat", "repeat"),  # two names; Any, because callers unpack maps
        ) -> None: ...

    def __post_init__(self):
        if len(self.wrap) != 2 or not set(self.wrap) <= set(WRAPS):
            raise ValueError(f"wrap: expected two of {', '.join(WRAPS)}, got {self.wrap}")
        base = tensor_of(self.base_color)
        size = base.shape[0] if isinstance(base, Tensor) and base.ndim else 0
        for name, channels in (("base_color", (3,)), ("roughness", ()), ("metallic", ()), ("normal", (3,))):
            value = tensor_of(getattr(self, name))
            if isinstance(value, (int, float)) and not channels:
                value = base.new_full((size, size), float(value))
            elif value is None and name == "normal":
                value = base.new_tensor(FLAT).repeat(size, size, 1)
            check(name, value, like=base)
            if not channels and value.ndim == 3 and value.shape[2] == 1:
                value = value[..., 0]
            if value.shape != (size, size, *channels) or size == 0:
                expected = "(T, T, 3)" if name == "base_color" else f"{(size, size, *channels)}"
                raise ValueError(f"{name}: expected shape {expected}, got {tuple(value.shape)}")
            object.__setattr__(self, name, value)

    @property
    def size(self) -> int:
        """Texels per side."""
        return self.base_color.shape[0]

    def __repr__(self) -> str:
        return f"TextureSet({self.size} x {self.size} texels, {self.base_color.device})"


@dataclass(frozen=True, repr=False)
class Asset(Movable):
    """A relightable object: mesh, textures and the estimated input lighting, if known.

    mesh: a :class:`~reli3d.geometry.mesh.Mesh`, with ``uv`` if there are textures (:func:`reli3d.unwrap`).  textures: a
    :class:`TextureSet`; None: a gray dielectric.  environment: an :class:`~reli3d.render.environment.Environment` or
    None.  Methods: ``.to(device)``, ``.detach()``.  Gradients pass through.  Raises TypeError for a wrong type.

    >>> asset = reli3d.Asset(mesh, reli3d.TextureSet(torch.full((64, 64, 3), 0.5), roughness=0.4, metallic=0.0))
    >>> image = reli3d.render_asset(asset, camera, light)
    """

    mesh: Mesh
    textures: TextureSet = None  # type: ignore[assignment] # without: a gray dielectric
    environment: Environment | None = None

    def __post_init__(self):
        expect("mesh", self.mesh, Mesh)
        for name, kind in (("textures", TextureSet), ("environment", Environment)):
            if getattr(self, name) is not None:
                expect(name, getattr(self, name), kind)

    @property
    def light(self) -> Environment:
        """``environment``; raises ValueError if it is None."""
        return present("asset.environment", self.environment)

    def __repr__(self) -> str:
        maps = "no textures" if self.textures is None else f"{self.textures.size} x {self.textures.size} texels"
        light = "no environment"
        if self.environment is not None:
            light = "environment {} x {}".format(*self.environment.radiance.shape[:2])
        vertices, faces = self.mesh.vertices, self.mesh.faces
        return f"Asset({len(vertices)} vertices, {len(faces)} faces, {maps}, {light}, {vertices.device})"
