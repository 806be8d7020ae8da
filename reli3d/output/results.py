"""The files of one reconstruction: written beside their place first, then moved, so that none is ever half there."""

from __future__ import annotations

import json
import os
import shutil
import sys
from dataclasses import asdict
from importlib.metadata import version
from pathlib import Path

import numpy as np

import reli3d
from reli3d.geometry.mesh import Mesh, report
from reli3d.io.glb import write_glb
from reli3d.io.hdr import write_environment
from reli3d.io.images import write_png
from reli3d.nn.weights import Manifest
from reli3d.output.viewer import viewer_page
from reli3d.render.asset import Asset
from reli3d.views.similarity import Similarity
from reli3d.views.views import Views

FILES = ("mesh.glb", "environment.exr", "environment.hdr", "preview.png", "viewer.html", "run_info.json")
COMPARISON = "refine.png"  # of a refinement
PUBLISHED_LIGHT = "illumination.hdr"  # name of the light in the published release, whose centre column is -Z


def complete(folder: Path, *, compatible: bool = False, refined: bool = False) -> bool:
    """Whether ``folder`` holds every file of a reconstruction, with ``compatible`` the published name too."""
    return all((folder / name).is_file() for name in _names(compatible, refined))


def _names(compatible: bool, refined: bool) -> tuple[str, ...]:
    return (*FILES, *([PUBLISHED_LIGHT] if compatible else []), *([COMPARISON] if refined else []))


def mesh_statistics(mesh: Mesh) -> dict:
    """The report of the mesh welded across its UV seams, as plain values."""
    return asdict(report(mesh))


def peak_memory_mib() -> float | None:
    """Most memory that this process has held, MiB, to a tenth; None on Windows, where Python has no such count."""
    try:
        import resource
    except ImportError:
        return None
    unit = 1 if sys.platform == "darwin" else 1024
    return round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 2**20, 1)


def write_results(
    folder: Path,
    asset: Asset,
    views: Views,
    picture: np.ndarray,
    info: dict,
    *,
    compatible: bool = False,
    comparison: np.ndarray | None = None,
) -> None:
    """Write :data:`FILES` into ``folder``; an error leaves what was there before.  Raises OSError, ValueError.

    views: the photographs, in the frame of ``asset``.  picture: :func:`~reli3d.output.preview.preview` of both.
    info: what ``run_info.json`` holds, the convention of the light apart.
    compatible: write the light as :data:`PUBLISHED_LIGHT` as well.  comparison: the picture of a refinement.
    """
    radiance = asset.environment.radiance
    info = {**info, "environment_centre": "+X"}
    folder.parent.mkdir(parents=True, exist_ok=True)
    temporary = folder.with_name(f".{folder.name}.{os.getpid()}.partial")
    temporary.mkdir()
    try:
        extras = {k: info[k] for k in ("output_from_input", "model_from_input", "weights")}
        write_glb(temporary / "mesh.glb", asset, extras=extras)
        for name in ("environment.exr", "environment.hdr"):
            write_environment(temporary / name, radiance)
        if compatible:
            write_environment(temporary / PUBLISHED_LIGHT, radiance, centre="-Z")
        write_png(temporary / "preview.png", picture)
        if comparison is not None:
            write_png(temporary / COMPARISON, comparison)
        low, high = asset.mesh.vertices.aminmax(dim=0)
        page = viewer_page(info["object"], {"mesh": (temporary / "mesh.glb").read_bytes()}, radiance,
                           (low + high) / 2, float((high - low).norm()) / 2, views)  # fmt: skip
        (temporary / "viewer.html").write_text(page)
        (temporary / "run_info.json").write_text(json.dumps(info, indent=1) + "\n")
        folder.mkdir(exist_ok=True)
        for name in _names(compatible, comparison is not None):
            os.replace(temporary / name, folder / name)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def frame_record(model_from_input: Similarity, output_from_input: Similarity, frame: str, up: str) -> dict:
    """The frames of the output, as matrices on column vectors."""
    return {"frame": frame, "up": up, "model_from_input": model_from_input.matrix().tolist(),
            "output_from_input": output_from_input.matrix().tolist()}  # fmt: skip


def weights_record(manifest: Manifest, digest: str) -> dict:
    """Name, hash and licence of the weights."""
    return {"file": Path(manifest.path).name, "sha256": digest, "licence": manifest.licence}


def versions() -> dict[str, str]:
    """Versions of this package and of those that compute."""
    others = {name: version(name) for name in ("torch", "warp-lang", "embreex", "numpy")}
    return {"reli3d": reli3d.__version__, **others}  # also from a checkout that is not installed
