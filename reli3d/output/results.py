"""Writes the files of one reconstruction atomically, by :mod:`reli3d.output.folder`."""

import json
import os
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from functools import partial
from importlib.metadata import version
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

import reli3d
from reli3d.errors import InputError, printable, shown
from reli3d.geometry.camera import camera_rays
from reli3d.geometry.mesh import Mesh, report
from reli3d.geometry.rays import RayScene
from reli3d.io.glb import glb_bytes
from reli3d.io.hdr import write_environment
from reli3d.io.images import png_bytes, write_png
from reli3d.nn.blocks import submit
from reli3d.output.viewer import Shown, photograph_stops, shadow, viewer_page
from reli3d.render.asset import Asset
from reli3d.views.similarity import Similarity
from reli3d.views.views import Views

FILES = ("mesh.glb", "environment.exr", "environment.hdr", "preview.png", "viewer.html", "run_info.json")
COMPARISON = "refine.png"  # of a refinement
SILHOUETTE_PIXELS = 256  # along a side of the masks of :func:`mask_iou`
OURS = (*FILES, COMPARISON, "illumination.hdr")  # removed from the folder of an older result


def complete(folder: Path, source: Path, *, refined: bool = False) -> bool:
    """Whether ``folder`` holds every file of a reconstruction.  Raises InputError for one of another ``source``."""
    if not all((folder / name).is_file() for name in (*FILES, *([COMPARISON] if refined else []))):
        return False
    try:
        other = json.loads((folder / "run_info.json").read_bytes()).get("folder")
    except (ValueError, AttributeError):  # changed by others
        return False
    if other not in (None, os.path.realpath(source)):
        problem = f"expected the result of {shown(os.path.realpath(source))}, got that of {shown(other)}"
        raise InputError(folder, f"{problem}; give another --output, or leave out --skip-existing")
    return True


def measure(mesh: Mesh, scene: RayScene, views: Views) -> Callable[[], dict]:
    """Starts the measurements of a result in the pool; ``mesh``: the report of the mesh welded across UV seams."""
    return submit(lambda: {"mesh": asdict(report(mesh)), "mask_iou": mask_iou(scene, views)}, mesh.vertices.device)


def mask_iou(scene: RayScene, views: Views) -> float:
    """Mean IoU of the silhouettes of the mesh of ``scene`` and the masks of ``views`` in the same frame, to 1e-4."""
    batch = views.resampled(SILHOUETTE_PIXELS, crop=True)
    origins, directions = camera_rays(batch.camera)
    far = torch.full((directions[..., 0].numel(),), torch.inf, device=directions.device, dtype=torch.float32)
    free = scene.unoccluded(origins.reshape(-1, 3), directions.reshape(-1, 3), far)  # rays of one camera are contiguous
    hit = ~free.reshape(directions.shape[:-1])
    masks = batch.masks > 0.5
    both, either = ((a.sum((1, 2)).double()) for a in (masks & hit, masks | hit))
    return round(float((both / either.clamp(min=1)).mean()), 4)


def peak_memory_mib() -> float | None:
    """Peak resident memory of this process, MiB, to a tenth; None on Windows, where Python does not report it."""
    try:
        import resource
    except ImportError:
        return None
    unit = 1 if sys.platform == "darwin" else 1024
    return round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 2**20, 1)


def encode(
    asset: Asset,
    views: Views,
    record: Mapping,
    *,
    name: str,
    before: Asset | None = None,
    translation: Sequence[float] = (0.0, 0.0, 0.0),
    scene: RayScene | None = None,
) -> tuple[Callable[[], bytes], Callable[[], str]]:
    """Starts encoding ``mesh.glb`` and ``viewer.html`` in the pool; the results block until the content is ready.

    views: in the frame of ``asset``, as the page.  record: content of ``run_info.json``; frames and weights are also
    stored in ``mesh.glb``.  name: title of the page.  before: the asset before refinement, also shown on the page.
    translation: of the mesh in ``mesh.glb`` alone.  scene: rays against the mesh of ``asset``.
    """
    device = asset.mesh.vertices.device
    kept = submit(partial(shadow, asset.mesh, scene), device)  # the longest first
    extras = {k: record[k] for k in ("output_from_input", "model_from_input", "weights")}
    glb = submit(partial(glb_bytes, asset, extras=extras), device)
    moved = partial(glb_bytes, asset, extras=extras, translation=translation)
    stops = submit(partial(photograph_stops, views), device)
    started = None if before is None else submit(lambda: Shown(glb_bytes(before), shadow(before.mesh)), device)

    def page() -> str:
        # In a thread of the pool: may wait only for tasks that were submitted before it and that wait for no other.
        shown = {"mesh" if started is None else "after": Shown(glb(), kept())}
        if started is not None:
            shown["before"] = started()
        low, high = asset.mesh.vertices.aminmax(dim=0)
        middle, radius = (low + high) / 2, float((high - low).norm()) / 2
        return viewer_page(printable(name), shown, asset.light.radiance, middle, radius, stops())

    placed = submit(moved, device) if any(translation) else glb
    return placed, submit(page, device)


def write_results(
    replacing: Callable,
    asset: Asset,
    glb: Callable[[], bytes],
    page: Callable[[], str],
    sheet: np.ndarray,
    info: dict,
    *,
    comparison: np.ndarray | None = None,
) -> None:
    """Writes :data:`FILES`; on an error the folder is unchanged.  Raises OSError, ValueError.

    replacing: from :func:`.folder.claimed`.  glb, page: from :func:`encode`.  sheet, comparison: contact sheets of the
    asset and of a refinement.  info: content of ``run_info.json``, to which the environment convention is added.
    """
    info = {**info, "environment_centre": "+X"}  # a key that other programs read
    with replacing() as new:
        (new / "preview.png").write_bytes(png_bytes(sheet))
        (new / "mesh.glb").write_bytes(glb())
        for name in ("environment.exr", "environment.hdr"):
            write_environment(new / name, asset.light)
        if comparison is not None:
            write_png(new / COMPARISON, comparison)
        (new / "viewer.html").write_text(page(), encoding="utf-8")
        (new / "run_info.json").write_text(json.dumps(info, indent=1) + "\n")


def frame_record(
    model_from_views: Similarity, output_from_views: Similarity, origin: Sequence[float], up: str
) -> tuple[dict, list[float]]:
    """The frames of the output, as matrices on column vectors, and the translation of the output mesh.

    origin: origin of the views' frame in the folder's frame; the matrices map from the folder's frame.
    """
    shift = torch.tensor(origin, dtype=torch.float64, device="cpu")
    read = Similarity.without_rotation(-shift)
    back = output_from_views.rotation @ shift
    output = Similarity(output_from_views.scale, output_from_views.rotation, output_from_views.translation + back)
    return {
        "up": up,
        "model_from_input": model_from_views.compose(read).matrix().tolist(),
        "output_from_input": output.compose(read).matrix().tolist(),
    }, back.tolist()


def camera_record(names: Sequence[str], c2w: Tensor, translation: Sequence[float]) -> list[dict]:
    """Names and camera-to-world matrices of views, in the scene frame of the GLB, whose mesh has ``translation``."""
    exact = c2w.cpu().double()
    exact[:, :3, 3] += torch.tensor(translation, dtype=torch.float64, device="cpu")
    return [{"name": n, "transform_matrix": m} for n, m in zip(names, exact.tolist(), strict=True)]


def versions() -> dict[str, str]:
    others = {name: version(name) for name in ("torch", "warp-lang", "embreex", "numpy")}
    return {"reli3d": reli3d.__version__, **others}  # also from a checkout that is not installed
