"""The whole loss of one object in one stage."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from reli3d.geometry.camera import Camera
from reli3d.geometry.rays import RayScene
from reli3d.nn.model import Code, Reconstructor
from reli3d.render.environment import Environment
from reli3d.render.gaussians import shade_gaussians
from reli3d.render.points import SurfacePoints
from reli3d.render.shading import ShadeOptions, shade
from reli3d.train.stages import losses
from reli3d.train.stages.config import StageConfig
from reli3d.train.stages.picture import Picture, lobes
from reli3d.train.stages.surface import Shader, render_surface, seed_surface, surface
from reli3d.train.stages.views import Draw
from reli3d.train.stages.volume import occupied, render_volume

DIFFUSE_MODEL = "published"  # the formula of the images of reli3d.synthetic.samples


def encode(model: Reconstructor, drawn: Draw, *, bfloat16: bool = False) -> Code:
    """What the network makes of the views that are read."""
    views = drawn.inputs
    shown = torch.tensor([drawn.background_visible], device=views.images.device)
    with torch.autocast(views.images.device.type, torch.bfloat16, enabled=bfloat16):
        return model.encode(
            views.images[None], views.masks[None], views.c2w[None], views.intrinsics[None], background_visible=shown
        )


def shader_of(model: Reconstructor, code: Code, stage: StageConfig, seed: int) -> Shader:
    """The light of a stage on points of a surface."""
    if stage.renderer == "gaussians":
        light = lobes(model, code, stage.lobes)
        return lambda points, wo, scene: shade_gaussians(points, wo, light)
    environment = Environment(model.decode_environment(code)[0].contiguous())
    options = ShadeOptions(samples=stage.samples, seed=seed, diffuse_model=DIFFUSE_MODEL)

    def lit(points: SurfacePoints, wo: Tensor, scene: RayScene) -> Tensor:
        return shade(points, wo, environment, scene=scene if stage.shadows else None, options=options)

    return lit


def pictures(
    model: Reconstructor, code: Code, drawn: Draw, stage: StageConfig
) -> tuple[list[Picture], dict[str, Tensor]]:
    """The renders of the views to compare, and what the geometry itself asks for.

    No pictures where the field has no surface yet: then the terms say where one shall be.
    """
    target, size = drawn.targets, drawn.targets.images.shape[1]
    cameras = [Camera(target.c2w[v], target.intrinsics[v], size, size) for v in range(len(target))]
    if stage.renderer == "volume":
        light, grid = lobes(model, code, stage.lobes), occupied(model, code, stage)
        return [
            render_volume(model, code, camera, light, grid, stage, drawn.seed + v) for v, camera in enumerate(cameras)
        ], {}
    found = surface(model, code, stage.resolution or model.preset.resolution)
    if found is None:
        return [], {"sign": seed_surface(model, code)}
    shader = shader_of(model, code, stage, drawn.seed)
    return [render_surface(model, code, found, camera, shader) for camera in cameras], found.terms


def object_losses(
    model: Reconstructor, drawn: Draw, stage: StageConfig, distance: losses.Perceptual, *, bfloat16: bool = False
) -> dict[str, Tensor]:
    """Unweighted terms of one object, each a scalar, by the names of ``stage.weights``; what is not known is not in it.

    Terms of several target views are their means over the views that have them.
    """
    code = encode(model, drawn, bfloat16=bfloat16)
    shown, terms = pictures(model, code, drawn, stage)
    target = drawn.targets
    of_views: dict[str, list[Tensor]] = {}
    for view, picture in enumerate(shown):
        got, want = losses.shown_colors(picture, target, view)
        mask = losses.opacity_entropy if stage.renderer == "volume" else losses.cover_error
        found = {
            "image": (got - want).square().mean(),
            "perceptual": distance(got, want),
            "mask": mask(picture, target, view),
            **losses.map_terms(picture, target, view),
        }
        for name, value in found.items():
            of_views.setdefault(name, []).append(value)
    terms = {**terms, **{name: torch.stack(values).mean() for name, values in of_views.items()}}
    light = lobes(model, code, 64).amplitude  # 64 directions tell the color of a light
    return {**terms, **losses.light_terms(code.latent[0], code.rotation[0], code.strength[0], light, drawn.inputs)}


def total(terms: dict[str, Tensor], stage: StageConfig) -> Tensor:
    """The weighted sum."""
    weights = vars(stage.weights)
    return sum((weights[name] * value for name, value in terms.items()), start=torch.zeros(()))


def trunk_layers(model: Reconstructor) -> list[Any]:
    """The layers of encoders and transformers: a few large modules of which one is needed at a time."""
    layers: list[Any] = [
        *model.encoder.model.encoder.layer,
        *model.illumination.encoder.model.encoder.layer,
        *model.illumination.transformer.transformer_blocks,
    ]
    blocks: Any = model.backbone.main_blocks
    for block in blocks:
        layers += [block.fuse_block_in, *list(block.transformer_block), block.fuse_block_out]
    return layers


def checkpointed(model: Reconstructor) -> None:
    """Let the trunk's layers be computed again in the backward pass instead of kept, in place."""
    from torch.utils.checkpoint import checkpoint

    for layer in trunk_layers(model):
        layer.forward = _again(checkpoint, layer.forward)


def _again(checkpoint: Callable, forward: Callable) -> Callable:
    return lambda *inputs: checkpoint(forward, *inputs, use_reentrant=False)
