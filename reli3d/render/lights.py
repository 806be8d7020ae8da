"""Two procedural environments: a studio and a clear sky.

Both have mean radiance 1 over the sphere, so the radiance of a diffuse surface approximately equals its albedo.
"""

import math
from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn.functional import normalize

from reli3d._bridge import full_precision
from reli3d.render.environment import Environment
from reli3d.render.latlong import lat_long_directions, texel_solid_angles

SUN_RADIUS = 0.055  # rad, about 12 times that of the sun: a texel of a small map is 0.05 wide
SUN_FRACTION = 0.45  # of the total radiance
SOFTBOXES = (  # direction of the middle, half width and half height [tangents of angles], radiance
    ((-0.75, 0.5, 0.6), 0.45, 0.6, (9.0, 8.8, 8.4)),  # key
    ((0.9, 0.25, 0.35), 0.16, 0.8, (3.6, 3.8, 4.2)),  # strip
    ((0.25, 0.45, -0.9), 0.8, 0.12, (5.0, 5.0, 5.0)),  # rim, behind
    ((0.05, 1.0, 0.0), 0.5, 0.5, (2.5, 2.5, 2.5)),  # above
)


def _vector(values: Sequence[float]) -> Tensor:
    return torch.tensor(values, dtype=torch.float32, device="cpu")


@full_precision
def studio(height: int = 64) -> Environment:
    """Gray surroundings with four softboxes: key light on the left, strip on the right, one behind and one above."""
    d = lat_long_directions(height)
    y = d[..., 1:2]
    light = (0.22 + 0.12 * y).expand(-1, -1, 3)
    edge = 2.0 * math.pi / height  # a softbox fades over two texels
    for middle, width, rise, radiance in SOFTBOXES:
        axis = normalize(_vector(middle), dim=0)
        right = normalize(torch.linalg.cross(_vector([0.0, 1.0, 1e-3]), axis), dim=0)
        depth = d @ axis
        across = (d @ right).abs() / depth.clamp(min=1e-3)
        above = (d @ torch.linalg.cross(axis, right)).abs() / depth.clamp(min=1e-3)
        inside = torch.sigmoid(4.0 * (width - across) / edge) * torch.sigmoid(4.0 * (rise - above) / edge)
        light = light + (inside * (depth > 0))[..., None] * _vector(radiance)
    return _of_mean_one(light)


@full_precision
def sky(height: int = 64) -> Environment:
    """Clear sky over brown ground, with the sun at 40 degrees elevation, in front on the right."""
    d = lat_long_directions(height)
    y = d[..., 1:2]
    up = torch.lerp(_vector([0.75, 0.85, 1.0]), _vector([0.16, 0.36, 0.85]), y.clamp(min=0.0).sqrt())
    ground = _vector([0.2, 0.17, 0.13])
    light = torch.lerp(ground.expand_as(up), up, torch.sigmoid(y * height))  # the horizon fades over a texel
    sun = normalize(_vector([0.5, math.sin(math.radians(40.0)), 0.58]), dim=0)
    away = torch.linalg.cross(d, sun.expand_as(d)).norm(dim=-1).atan2(d @ sun)
    disk = torch.sigmoid((SUN_RADIUS - away) * (2.0 * height / math.pi))[..., None] * _vector([1.0, 0.9, 0.75])
    return _of_mean_one(light / _mean(light) + disk / _mean(disk) * (SUN_FRACTION / (1.0 - SUN_FRACTION)))


LIGHTS = {"studio": studio, "sky": sky}


def _mean(light: Tensor) -> float:
    """Mean radiance over the sphere and the channels."""
    angle = texel_solid_angles(*light.shape[:2]) / (4.0 * math.pi)
    return float((light.mean(-1).sum(1).double() * angle).sum())


def _of_mean_one(light: Tensor) -> Environment:
    return Environment((light / _mean(light)).contiguous())
