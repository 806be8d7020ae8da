"""Posed masks of unions of spheres, in closed form: a ray meets a sphere or not."""

import math

import torch

from reli3d.geometry.camera import Camera, camera_rays, look_at
from reli3d.views.views import Views

SPHERES = ((0.0, 0.0, 0.0, 0.3), (0.35, 0.1, 0.0, 0.15), (0.0, 0.38, 0.1, 0.12), (-0.1, -0.1, 0.4, 0.1))  # no symmetry


def eyes_around(count: int, distance: float = 2.2) -> torch.Tensor:
    """``(count, 3)`` eyes spread over azimuth and height (golden angle)."""
    k = torch.arange(count, dtype=torch.float64)
    z = 0.7 * torch.cos(2.1 * k)
    phi = 2.4 * k
    r = (1 - z * z).sqrt()
    return distance * torch.stack([r * torch.sin(phi), z, r * torch.cos(phi)], -1)


def sphere_views(spheres=SPHERES, count=4, *, distance=2.2, size=(120, 96), fov=0.7, eyes=None):
    """Views of ``size`` (width, height) of spheres ``(x, y, z, radius)`` with cameras about the origin."""
    width, height = size
    eyes = (eyes_around(count, distance) if eyes is None else torch.as_tensor(eyes)).float()
    c2w = look_at(eyes, torch.zeros_like(eyes), torch.tensor([0.05, 1.0, 0.02]).expand(len(eyes), 3))
    focal = 0.5 * width / math.tan(0.5 * fov)
    intrinsics = torch.tensor([focal, focal, 0.5 * width + 3, 0.5 * height - 2]).expand(len(eyes), 4).contiguous()
    origins, directions = camera_rays(Camera(c2w, intrinsics, width, height))
    masks = torch.zeros(len(eyes), height, width)
    for x, y, z, radius in spheres:
        away = torch.tensor([x, y, z]) - origins
        along = (away * directions).sum(-1)
        masks[(away.square().sum(-1) - along.square() <= radius**2) & (along > 0)] = 1.0
    images = tuple(m[..., None].expand(-1, -1, 3) * 0.6 for m in masks)
    return Views(images, tuple(masks), c2w, intrinsics, tuple(f"{i}.png" for i in range(len(eyes))))


def rig(*at: tuple[float, float, float], target=(0.3, -0.2, 5.0)) -> torch.Tensor:
    """Cameras at azimuth and elevation [degrees] and distance that look at ``target``."""
    rows = []
    for azimuth, elevation, distance in at:
        a, e = math.radians(azimuth), math.radians(elevation)
        away = torch.tensor([math.cos(e) * math.sin(a), math.sin(e), math.cos(e) * math.cos(a)])
        middle = torch.tensor(target)
        rows.append(look_at(middle + distance * away, middle, torch.tensor([0.0, 1.0, 0.0])))
    return torch.stack(rows)
