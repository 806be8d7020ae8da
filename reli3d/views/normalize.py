"""Transform from the frame of the input cameras to the network's frame, from a coarse visual hull of the object."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import max_pool2d, pad

from reli3d._bridge import full_precision
from reli3d.errors import InputError
from reli3d.views.similarity import Similarity
from reli3d.views.views import Views, mask_box, whole_views

RADIUS = 0.87  # half side of the network's cube, and of the sphere in which pixels have depths
KEPT_HULL_SIDE = 0.8, 1.15  # longest side of a hull whose poses are kept; in training the object's is 1
MAX_HULL_COORDINATE = 0.62  # its greatest coordinate: a tenth more than the side of the network's feature volume
GRIDS = (24, 44)  # cells a side, coarse and refined: the last is 2 to 3 % of the object
BALL = 1.3  # diameter of the ball that limits the hull, in mask widths: a generic view shows 0.8 of the longest side
ONE_SIDED = math.radians(90.0)  # between eyes: beyond it the views bound each other's depth
PARALLEL_AXES_SINE2 = 0.01  # mean squared sine between axes (6 degrees) below which depth is not triangulated
FAR_DISTANCES = 10.0  # to the object, from which the origin is moved to it: float32 would lose a digit of positions
MIN_OBJECT_DISTANCE = 1e-6  # distance to the object below which squares of areas of a mesh's faces leave float32
POSITION_PRECISION = 1e-6  # of a position: matrices are often written with seven digits
COINCIDENT_EYES = 1e-12  # of the eyes' distance from the origin: nearer ones differ by float64's rounding alone
EYE_RESOLUTION = 1e-6  # of an eye's distance from the origin: float32 does not resolve a smaller distance to the eye


@dataclass(frozen=True)
class Hull:
    """Grid cells that project into every mask; empty if cameras and masks are inconsistent."""

    points: Tensor  # (N, 3) float64 cell centers
    cell: float  # side of a cell
    aim: Tensor  # (3,) where the views look
    extent: float  # longest lateral side of the masks at ``aim``

    def middle(self) -> Tensor:
        """Mean of the cells, or where the views look if there are none."""
        return self.points.mean(0) if len(self.points) else self.aim

    def box(self) -> tuple[Tensor, Tensor]:
        """Lower and upper corner ``(3,)``, to half a cell.  Raises InputError for an empty hull."""
        if len(self.points) == 0:
            raise InputError("hull", "expected a point inside all masks, got none; run reli3d check to see the cameras")
        return self.points.amin(0), self.points.amax(0)  # the border runs through the outermost cells


@full_precision
def normalize(views: Views, mode: str = "auto") -> Similarity:
    """The transform from the frame of the input cameras to the network's frame (no rotation).

    mode ``none``: identity.  ``hull``: the visual hull's box is centered, its longest side scaled to 1.
    ``auto``: the same with ``views.object_box`` if there is one; else the identity if the longest side of
    the hull is 0.8 to 1.15, its coordinates are at most 0.62 and it lies in a sphere of radius 0.87; else ``hull``.

    With all cameras within 90 degrees, the hull is cut at 1.3 times the width of the masks and the box aligned with the
    mean viewing direction.  From one direction, the depth is the width, nearest to the origin.  Raises InputError if no
    point lies inside all masks.
    """
    if mode not in ("auto", "none", "hull"):
        raise ValueError(f"mode: expected auto, none or hull, got {mode!r}")
    if mode == "none":
        return Similarity.identity()
    if mode == "auto" and views.object_box is not None:
        low, high = torch.tensor(views.object_box, dtype=torch.float64, device="cpu")
        longest = float((high - low).max())
        return Similarity.without_rotation(-(low + high) / (2 * longest), 1.0 / longest)
    hull = visual_hull(views)
    low, high = hull.box()
    inside = torch.maximum(-low, high).max() <= MAX_HULL_COORDINATE and hull.points.norm(dim=-1).max() <= RADIUS
    basis = _one_sided_basis(views, hull)
    points = hull.points @ basis
    low, high = points.amin(0), points.amax(0)
    longest, center = float((high - low).max()), basis @ ((low + high) / 2)
    if mode == "auto" and inside and KEPT_HULL_SIDE[0] <= longest <= KEPT_HULL_SIDE[1]:
        return Similarity.identity()
    return Similarity.without_rotation(-center / longest, 1.0 / longest)


def _one_sided_basis(views: Views, hull: Hull) -> Tensor:
    """Orthonormal columns along which the hull's sides are measured: the axes, or those of a one-sided capture.

    Where all eyes lie within ONE_SIDED of each other seen from the object, the silhouettes leave the depth open and the
    ball cuts the hull.  The last column is then the mean viewing direction, the first the horizontal of view 0: sides
    in other axes would depend on how the frame is turned.
    """
    c2w = views.c2w.double().cpu()
    away = torch.nn.functional.normalize(c2w[:, :3, 3] - hull.aim, dim=-1)
    axis = torch.nn.functional.normalize(away.mean(0), dim=-1)
    across = torch.linalg.cross(c2w[0, :3, 1], axis)
    parallel = meeting_point(c2w[:, :3, 3], -away)[1] < PARALLEL_AXES_SINE2
    if parallel or float((away @ away.T).min()) < math.cos(ONE_SIDED) or float(across.norm()) < 1e-3:
        return torch.eye(3, dtype=torch.float64, device="cpu")
    right = torch.nn.functional.normalize(across, dim=-1)
    return torch.stack([right, torch.linalg.cross(axis, right), axis], -1)


@full_precision
def visual_hull(views: Views) -> Hull:
    """Coarse visual hull of ``views``, on the CPU: a grid where the views meet, refined once to the box of its cells.

    A cell is kept if, in every view, the maximum of the mask over the cell's footprint exceeds one half, so that thin
    parts are not lost; beyond the image border, the mask has its border values.  The hull is clipped to a ball with a
    diameter derived from the masks' width, which bounds it along rays that no other view crosses.  Views whose mask
    touches the border are ignored if at least LEAST_WHOLE others remain.
    """
    views = views.select(whole_views(views.masks))
    c2w, intrinsics = views.c2w.double().cpu(), views.intrinsics.double().cpu()
    masks = [m.cpu() for m in views.masks]
    origins, rays = c2w[:, :3, 3], center_rays(masks, c2w, intrinsics)
    aim, spread = meeting_point(origins, rays)
    depth = ((aim - origins)[:, None] @ -c2w[:, :3, 2:3])[:, 0, 0]  # along the viewing axes
    if not bool((depth > EYE_RESOLUTION * origins.norm(dim=-1).max()).all()):
        return Hull(origins.new_zeros(0, 3), 0.0, aim, 0.0)
    boxes = torch.tensor([mask_box(m) for m in masks], dtype=torch.float64, device="cpu")
    sides = (boxes[:, 2:] - boxes[:, :2]) / intrinsics[:, :2] * depth[:, None]
    extent = float(sides.max())
    ball = 0.5 * extent * (BALL if spread >= PARALLEL_AXES_SINE2 else 1.0)  # views from one side: as deep as wide
    low, high = aim - ball, aim + ball
    for grid in GRIDS:
        cell = float((high - low).max()) / grid
        counts = ((high - low) / cell).ceil().int().tolist()
        axes = [torch.arange(n, dtype=torch.float64, device="cpu") for n in counts]
        points = low + (torch.cartesian_prod(*axes) + 0.5) * cell
        points = points[(points - aim).norm(dim=-1) <= ball]
        for mask, pose, camera in zip(masks, c2w, intrinsics):
            points = points[_covered(points, mask, pose, camera, cell)]
        if len(points) == 0:
            break
        low, high = points.amin(0) - cell, points.amax(0) + cell
    return Hull(points, cell, aim, extent)


@full_precision
def center_rays(masks: list[Tensor], c2w: Tensor, intrinsics: Tensor) -> Tensor:
    """Unit rays ``(V, 3)`` through the middle of each mask's box, world frame."""
    boxes = torch.tensor([mask_box(m) for m in masks], dtype=c2w.dtype, device="cpu")
    middle = (boxes[:, :2] + boxes[:, 2:]) / 2
    x, y = ((middle - intrinsics[:, 2:]) / intrinsics[:, :2]).unbind(-1)
    local = torch.stack([x, -y, -torch.ones_like(x)], -1)
    return torch.nn.functional.normalize((c2w[:, :3, :3] @ local[..., None])[..., 0], dim=-1)


@full_precision
def meeting_point(origins: Tensor, rays: Tensor) -> tuple[Tensor, float]:
    """The point ``(3,)`` nearest to all rays, and how well they determine it: least mean squared sine, 0 if parallel.

    Below PARALLEL_AXES_SINE2, the point of the mean ray nearest to the origin, or at unit distance if that point lies
    behind a camera.
    """
    across = torch.eye(3, dtype=rays.dtype, device=rays.device) - rays[:, :, None] * rays[:, None]
    system = across.mean(0)
    spread = float(torch.linalg.eigvalsh(system)[0])
    if spread >= PARALLEL_AXES_SINE2:
        return torch.linalg.solve(system, (across @ origins[..., None]).mean(0)[:, 0]), spread
    eye, ray = origins.mean(0), torch.nn.functional.normalize(rays.mean(0), dim=-1)
    distance = float(-(eye @ ray))
    return eye + ray * (distance if distance > 0 else 1.0), spread


def near_origin(c2w: Tensor) -> Tensor:
    """New origin ``(3,)`` float64 for cameras ``c2w (V, 4, 4)`` float64.

    The point that the cameras look at, if the origin of their frame is more than FAR_DISTANCES times as far from this
    point as the cameras are; else zero.  Raises InputError if cameras are nearer to the point than MIN_OBJECT_DISTANCE,
    unless all positions coincide, as for a rig around the origin with world-to-camera matrices.
    """
    eyes = c2w[:, :3, 3]
    if len(eyes) > 1 and float((eyes - eyes[0]).abs().max()) <= COINCIDENT_EYES * float(eyes.abs().max()):
        return torch.zeros_like(eyes[0])
    aim = meeting_point(eyes, -c2w[:, :3, 2])[0]
    reach = float((eyes - aim).norm(dim=-1).median())
    if reach < MIN_OBJECT_DISTANCE and float((eyes - aim).abs().max()) > POSITION_PRECISION * float(eyes.abs().max()):
        raise InputError(
            "cameras",
            f"expected a distance of {MIN_OBJECT_DISTANCE:g} or more to the object, got {reach:.3g}; scale poses up",
        )
    far = float(aim.norm()) > FAR_DISTANCES * reach and reach >= MIN_OBJECT_DISTANCE
    return aim if far else torch.zeros_like(aim)


def _covered(points: Tensor, mask: Tensor, pose: Tensor, camera: Tensor, cell: float) -> Tensor:
    """Whether the footprint of a cell of side ``cell`` about each point touches the mask; False behind the camera."""
    local = (points - pose[:3, 3]) @ pose[:3, :3]
    depth = (-local[:, 2]).clamp_min(1e-12)
    footprint = float((camera[:2] * cell / depth.median()).max()) if len(points) else 0.0
    height, width = mask.shape
    step = max(1, min(int(footprint // 3), max(height, width)))  # without end where most points are behind the camera
    if footprint > 1:  # maximum over 3 x 3 blocks of a third of a footprint: thin parts that one sample would skip
        mask = max_pool2d(pad(mask, (0, -width % step, 0, -height % step))[None], step)
        mask = max_pool2d(mask, 3, 1, 1)[0]
    scaled = torch.stack([camera[0] * local[:, 0], -camera[1] * local[:, 1]], -1) / depth[:, None] + camera[2:]
    limit = torch.tensor([width - 1, height - 1], dtype=torch.float64, device="cpu")
    pixel = torch.minimum(scaled.floor().clamp_min(0), limit).long() // step
    return (mask[pixel[:, 1], pixel[:, 0]] > 0.5) & (local[:, 2] < 0)
