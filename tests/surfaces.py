"""Points to shade, from arrays in the order of the estimator's formulas."""

from torch import Tensor

from reli3d.render.points import SurfacePoints


def at(position, normal, ng, wo, base_color, roughness, metallic) -> tuple[SurfacePoints, Tensor]:
    """The first two arguments of ``shade``."""
    return SurfacePoints(position, ng, normal, base_color, roughness, metallic), wo


def on_ball(normal, wo, base_color, roughness, metallic) -> tuple[SurfacePoints, Tensor]:
    """The same for points of the unit ball, whose three vectors are one."""
    return at(normal, normal, normal, wo, base_color, roughness, metallic)
