"""Mitsuba 3 as an outside judge of images: same mesh, same rays, same material formula, its own geometry and light."""

import glob
import math
import os

import numpy as np
import pytest
import torch


def load():
    """The mitsuba module in its LLVM variant, or a visible skip."""
    if "DRJIT_LIBLLVM_PATH" not in os.environ:
        found = sorted(glob.glob("/usr/lib/*/libLLVM-19.so*") + glob.glob("/usr/lib/*/libLLVM-2?.so*"))
        if not found:
            pytest.skip("needs LLVM 19 or newer for mitsuba's llvm variant (DRJIT_LIBLLVM_PATH)")
        os.environ["DRJIT_LIBLLVM_PATH"] = found[0]
    mi = pytest.importorskip("mitsuba")
    mi.set_variant("llvm_ad_rgb")
    return mi


def environment(mi, radiance: torch.Tensor) -> dict:
    """Mitsuba's envmap with the same bilinear function.

    Its rows are nodes at v = r / (H' - 1), ours texel centers: with H' = 2 H + 1 all our kinks fall on its nodes.
    Its columns are texel centers as ours.  Its center column looks to +Z, ours to +X: a quarter turn.
    """
    bitmap = mi.Bitmap(np.ascontiguousarray(node_rows(radiance).numpy(), np.float32))
    return {"type": "envmap", "bitmap": bitmap, "to_world": mi.ScalarTransform4f().rotate([0, 1, 0], 90)}


def node_rows(radiance: torch.Tensor) -> torch.Tensor:
    """The map ``(H, W, 3)`` on the ``2 H + 1`` rows of Mitsuba's nodes; differentiable."""
    height = radiance.shape[0]
    rows = torch.arange(2 * height + 1) / 2 - 0.5
    low = rows.floor().long().clamp(0, height - 1)
    high = (low + 1).clamp(max=height - 1)
    part = (rows.clamp(min=0.0) - rows.clamp(min=0.0).floor())[:, None, None]
    return radiance[low] * (1 - part) + radiance[high] * part


def smooth_mesh(mi, vertices: torch.Tensor, faces: torch.Tensor, normals: torch.Tensor, bsdf: dict, uv=None):
    """A mesh with vertex normals and the material; uv: ``(V, 2)``, v down, or None."""
    props = mi.Properties()
    props["bsdf"] = mi.load_dict(bsdf)
    mesh = mi.Mesh(
        "mesh", len(vertices), len(faces), props=props, has_vertex_normals=True, has_vertex_texcoords=uv is not None
    )
    params = mi.traverse(mesh)
    params["vertex_positions"], params["faces"] = vertices.numpy().ravel(), faces.numpy().ravel().astype(np.uint32)
    params["vertex_normals"] = normals.numpy().ravel()
    if uv is not None:
        params["vertex_texcoords"] = uv.numpy().ravel()
    params.update()
    return mesh


def sensor(mi, eye, target, fov_x: float, width: int, height: int):
    """``perspective`` with +Y up and a box filter; fov_x in radians."""
    film = {"type": "hdrfilm", "width": width, "height": height, "pixel_format": "rgba", "rfilter": {"type": "box"}}
    pose = mi.ScalarTransform4f().look_at(origin=list(eye), target=list(target), up=[0, 1, 0])
    return mi.load_dict({"type": "perspective", "fov": math.degrees(fov_x), "to_world": pose, "film": film})


def rays_through_pixel_centers(mi, sensor):
    """The sensor's own rays, row by row from the top: origins and directions ``(H W, 3)``."""
    width, height = (int(v) for v in sensor.film().size())
    y, x = np.meshgrid((np.arange(height) + 0.5) / height, (np.arange(width) + 0.5) / width, indexing="ij")
    place = mi.Point2f(x.ravel().astype(np.float32), y.ravel().astype(np.float32))
    ray, _ = sensor.sample_ray(0.0, 0.5, place, mi.Point2f(0.5))
    return tuple(torch.from_numpy(np.array(v).T.copy()) for v in (ray.o, ray.d))


def radiance(mi, scene, origins: torch.Tensor, directions: torch.Tensor, samples: int, passes: int):
    """Mean ``(N, 3)`` of direct light along rays by ``path`` of depth 2, and the variance of one of its samples.

    ``passes`` times ``samples`` samples a ray, each one draw of the light and one of the material.
    """
    integrator = mi.load_dict({"type": "path", "max_depth": 2, "hide_emitters": True})
    o, d = (v.repeat_interleave(samples, 0).numpy().T for v in (origins, directions))
    ray = mi.RayDifferential3f(mi.Point3f(o), mi.Vector3f(d))
    total, square = 0.0, 0.0
    for k in range(passes):
        sampler = mi.load_dict({"type": "independent"})
        sampler.seed(k + 1, len(origins) * samples)
        value = np.array(integrator.sample(scene, sampler, ray)[0]).T.reshape(-1, samples, 3).astype(np.float64)
        total, square = total + value.sum(1), square + (value**2).sum(1)
    count = samples * passes
    mean = total / count
    return mean, np.maximum(square / count - mean**2, 0.0) * count / (count - 1)
