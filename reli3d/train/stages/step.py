"""The losses of one object in one stage."""

from functools import partial

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from reli3d.fit.lighting import DIFFUSE_MODEL
from reli3d.geometry.camera import Camera
from reli3d.geometry.rays import RayScene
from reli3d.nn.model import Code, Reconstructor
from reli3d.nn.tokenizers import EncoderLayer
from reli3d.nn.transformer import BasicBlock, FuseBlock
from reli3d.render.environment import Environment
from reli3d.render.gaussians import shade_gaussians
from reli3d.render.points import SurfacePoints
from reli3d.render.shading import ShadeOptions, shade
from reli3d.train.stages import losses
from reli3d.train.stages.config import StageConfig
from reli3d.train.stages.rendering import Rendering, lobes
from reli3d.train.stages.surface import Shader, render_surface, seed_surface, surface
from reli3d.train.stages.views import Draw
from reli3d.train.stages.volume import occupied, render_volume

CHECKPOINTED = (EncoderLayer, FuseBlock, BasicBlock)  # units of gradient checkpointing


def encode(model: Reconstructor, drawn: Draw, *, bfloat16: bool = False) -> Code:
    views = drawn.inputs
    shown = torch.tensor([drawn.background_visible], device=views.images.device)
    with torch.autocast(views.images.device.type, torch.bfloat16, enabled=bfloat16):
        inputs = (t[None] for t in (views.images, views.masks, views.c2w, views.intrinsics))
        return model.encode(*inputs, background_visible=shown)


def shader_of(model: Reconstructor, code: Code, stage: StageConfig, seed: int) -> Shader:
    """The function that shades surface points under the predicted lighting, by the renderer of ``stage``."""
    if stage.renderer == "gaussians":
        light = lobes(model, code, stage.lobes)
        return lambda points, wo, scene: shade_gaussians(points, wo, light)
    environment = Environment(model.decode_environment(code)[0].contiguous())
    options = ShadeOptions(samples=stage.samples, seed=seed, diffuse_model=DIFFUSE_MODEL)

    def lit(points: SurfacePoints, wo: Tensor, scene: RayScene) -> Tensor:
        return shade(points, wo, environment, scene=scene if stage.shadows else None, options=options)

    return lit


def renderings(
    model: Reconstructor, code: Code, drawn: Draw, stage: StageConfig
) -> tuple[list[Rendering], dict[str, Tensor]]:
    """Renderings of the target views, none without a surface, and the regularization terms of the geometry."""
    target, size = drawn.targets, drawn.targets.images.shape[1]
    cameras = [Camera(target.c2w[v], target.intrinsics[v], size, size) for v in range(len(target))]
    if stage.renderer == "volume":
        light, grid = lobes(model, code, stage.lobes), occupied(model, code, stage)
        seeds = range(drawn.seed, drawn.seed + len(cameras))
        return [render_volume(model, code, c, light, grid, stage, s) for c, s in zip(cameras, seeds, strict=True)], {}
    found = surface(model, code, stage.resolution or model.preset.resolution)
    if found is None:
        return [], {"sign": seed_surface(model, code)}
    shader = shader_of(model, code, stage, drawn.seed)
    return [render_surface(model, code, found, camera, shader) for camera in cameras], found.terms


def object_losses(
    model: Reconstructor, drawn: Draw, stage: StageConfig, distance: losses.Perceptual, *, bfloat16: bool = False
) -> dict[str, Tensor]:
    """Unweighted terms of one object by the names of ``stage.weights``, averaged over the views that have them."""
    code = encode(model, drawn, bfloat16=bfloat16)
    shown, terms = renderings(model, code, drawn, stage)
    target = drawn.targets
    of_views: dict[str, list[Tensor]] = {}
    for view, rendering in enumerate(shown):
        rendered, observed = losses.compared_colors(rendering, target, view)
        found = {
            "image": (rendered - observed).square().mean(),
            "perceptual": distance(rendered, observed),
            "mask": losses.mask_error(rendering, target, view, volume=stage.renderer == "volume"),
            **losses.map_terms(rendering, target, view),
        }
        for name, value in found.items():
            of_views.setdefault(name, []).append(value)
    terms = {**terms, **{name: torch.stack(values).mean() for name, values in of_views.items()}}
    light = lobes(model, code, 64).amplitude  # 64 directions determine the color of the lighting
    return {**terms, **losses.light_terms(code.latent[0], code.rotation[0], code.strength[0], light, drawn.inputs)}


def total(terms: dict[str, Tensor], stage: StageConfig) -> Tensor:
    """Weighted sum of ``terms``."""
    weights = vars(stage.weights)
    return sum((weights[name] * value for name, value in terms.items()), start=torch.zeros(()))


def checkpointed(model: Reconstructor) -> None:
    """Enables gradient checkpointing of the layers of the encoders and transformers, in place."""
    for layer in model.modules():
        if isinstance(layer, CHECKPOINTED):
            layer.forward = partial(checkpoint, layer.forward, use_reentrant=False)  # type: ignore[method-assign]
