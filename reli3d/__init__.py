"""Relightable 3D assets from posed photographs, and a library of differentiable operations for them.

The public API consists of the names in ``reli3d.__all__`` (documented by, for example, ``help(reli3d.shade)``), the
packages ``geometry``, ``render``, ``io`` and ``fit``, whose docstrings list their modules, and the module ``errors``.
All are imported on first use: ``import reli3d`` alone loads neither torch nor Warp.
"""

from importlib import import_module

__version__ = "0.3.0"

_MODULES = {
    "pipeline": ("reconstruct", "ReconstructOptions", "refine"),
    "views.folder": ("load_views",),
    "views.views": ("Views",),
    "geometry.camera": ("Camera", "camera_rays", "look_at"),
    "geometry.mesh": ("Mesh",),
    "geometry.rays": ("RayScene",),
    "geometry.hits": ("Hits",),
    "geometry.surface": ("CubeWeights", "extract_surface"),
    "geometry.triplane": ("sample_triplane",),
    "geometry.uv": ("unwrap",),
    "geometry.bake": ("bake",),
    "render.asset": ("Asset", "TextureSet"),
    "render.color": ("linear_to_srgb", "srgb_to_linear"),
    "render.environment": ("Environment",),
    "render.gbuffer": ("surface_points",),
    "render.image": ("Render", "render_asset"),
    "render.material": ("eval_bsdf", "pdf_bsdf", "sample_bsdf"),
    "render.points": ("SurfacePoints",),
    "render.sampling": ("antithetic", "pdf_ggx_vndf", "reflect", "sample_ggx_vndf", "tangent_frame"),
    "render.shading": ("Samples", "ShadeOptions", "shade"),
    "render.silhouette": ("antialias",),
    "io.glb": ("read_glb", "write_glb"),
    "io.hdr": ("read_environment", "write_environment"),
    "io.images": ("read_image", "write_image"),
}
_PUBLIC_MODULES = ("errors", "fit", "geometry", "io", "render")
_HOME = {name: f"{__name__}.{module}" for module, names in _MODULES.items() for name in names}
__all__ = ["__version__", *sorted(_HOME)]


def __getattr__(name: str):
    if name in _PUBLIC_MODULES:
        return import_module(f"{__name__}.{name}")
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(_HOME[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *_HOME, *_PUBLIC_MODULES})
