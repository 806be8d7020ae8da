"""Relightable 3D assets from a few posed photographs.

The names of the README example are loaded on first use: ``import reli3d`` alone starts neither torch nor Warp and
loads no network.  The function ``render`` stays in its module, ``reli3d.render.render``, because a name cannot be
both a subpackage and a function.
"""

from importlib import import_module

__version__ = "0.2.0"

_HOME = {
    "reconstruct": "reli3d.pipeline",
    "ReconstructOptions": "reli3d.pipeline",
    "refine": "reli3d.pipeline",
    "load_views": "reli3d.views.folder",
    "Views": "reli3d.views.views",
    "Camera": "reli3d.geometry.camera",
    "look_at": "reli3d.geometry.camera",
    "Environment": "reli3d.render.environment",
    "read_environment": "reli3d.io.hdr",
    "Asset": "reli3d.render.asset",
    "TextureSet": "reli3d.render.asset",
    "SurfacePoints": "reli3d.render.points",
    "ShadeOptions": "reli3d.render.shading",
    "shade": "reli3d.render.shading",
    "Mesh": "reli3d.geometry.mesh",
    "RayScene": "reli3d.geometry.rays",
    "extract_surface": "reli3d.geometry.surface",
    "unwrap": "reli3d.geometry.uv",
    "bake": "reli3d.geometry.bake",
    "sample_triplane": "reli3d.geometry.triplane",
    "write_image": "reli3d.io.images",
    "write_glb": "reli3d.io.glb",
    "read_glb": "reli3d.io.glb",
}
__all__ = ["__version__", *_HOME]


def __getattr__(name: str):
    if name not in _HOME:
        raise AttributeError(f"module 'reli3d' has no attribute {name!r}")
    value = getattr(import_module(_HOME[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *_HOME})
