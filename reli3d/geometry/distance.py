"""Signed distance to closed meshes, the ground truth for volume points in training."""

import torch
from torch import Tensor

from reli3d import _bridge
from reli3d.geometry.mesh import check_topology
from reli3d.geometry.rays import warp_mesh
from reli3d.kernels import distance as kernels


def signed_distance(vertices: Tensor, faces: Tensor, points: Tensor) -> Tensor:
    """Signed distance ``(N,)`` from ``points (N, 3)`` to a closed, outward-oriented mesh; negative inside.

    vertices: ``(V, 3)`` float32.  faces: ``(F, 3)`` int32.  The distance is in the units of the mesh.  No gradient.
    For a mesh with holes, the sign is undefined; a NaN point gives NaN.  Raises TypeError for a wrong dtype, ValueError
    for a wrong shape or device, an empty mesh or an index out of range.
    """
    check_topology(vertices, faces)
    _bridge.check("points", points, shape=("N", 3), like=vertices)
    if len(faces) == 0:
        raise ValueError("faces: expected at least one, got none")
    if not torch.isfinite(vertices).all():
        raise ValueError("vertices: expected finite coordinates, got NaN or infinity")
    vertices, faces, points = vertices.detach().contiguous(), faces.contiguous(), points.detach().contiguous()
    finite = torch.isfinite(points).all(-1)
    distance = points.new_empty(len(points))
    mesh = warp_mesh(vertices, faces)
    safe = torch.where(finite[:, None], points, torch.zeros_like(points))
    reach = 4.0 * float(torch.cat([vertices, safe]).abs().max()) + 1.0  # longer than any distance that can occur
    _bridge.launch(kernels.signed_distance_kernel, len(points), [mesh.id, safe, reach, distance], points.device)
    return torch.where(finite, distance, torch.full_like(distance, float("nan")))
