"""The training stages of the ReLi3D paper's network."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from reli3d.errors import InputError
from reli3d.nn.model import Reconstructor
from reli3d.train.stage import Stage
from reli3d.train.stages.config import TINY, StageConfig
from reli3d.train.stages.losses import gradients, lpips_distance
from reli3d.train.stages.step import checkpointed, encode, object_losses, renderings
from reli3d.train.stages.surface import surface
from reli3d.train.stages.views import Draw, Source, draw

CHECKED = 4  # objects whose surface is extracted at every checkpoint
VALIDATION_OBJECTS = 3  # validation objects in the image
TILE_PIXELS = 96  # pixels of a side of a tile of the image


@dataclass(frozen=True)
class PaperOptions:
    """Options of :class:`PaperStage`."""

    max_views: int = 4  # upper limit of the random number of input views; the first is the reference view
    background: float = 0.5  # fraction of the objects whose input includes the background
    distance: str = "gradients"  # or ``lpips``, the perceptual term
    bfloat16: bool = False  # autocast of the trunk
    checkpointing: bool = False  # recompute the trunk's layers in the backward pass

    def __post_init__(self) -> None:
        if not 1 <= self.max_views <= 16:
            raise ValueError(f"max_views: expected 1 to 16, got {self.max_views}")


class PaperStage(Stage):
    """Compares held-out views with renderings of the predicted object."""

    model: Reconstructor

    def __init__(
        self,
        model: Reconstructor,
        config: StageConfig,
        sources: Sequence[Source],
        options: PaperOptions = PaperOptions(),  # noqa: B008 # it is frozen
        *,
        seed: int = 0,
        validation: Source | None = None,
        folders: Sequence[str] = (),
    ):
        """validation: held-out objects.  folders: names of the sources for the log."""
        self.name, self.weights = config.name, vars(config.weights)
        self.settings = {"steps": config.steps, "batch": config.batch, "rate": config.rate}
        self.settings |= {"final_rate": 0.1, "weight_decay": 0.01, "clip": 1.0}
        self.model, self.config, self.sources = model, config, sources
        self.seed, self.given = seed, options
        self.distance = lpips_distance() if options.distance == "lpips" else gradients
        self.configuration = {"config": asdict(config), "folders": list(folders), **asdict(options)}
        if options.checkpointing:
            checkpointed(model)
        held_out = [validation] if validation else []
        self.held_out = [self.drawn(0, k, held_out, patch=0) for k in range(VALIDATION_OBJECTS * len(held_out))]

    def drawn(self, step: int, place: int, sources: Sequence[Source] | None = None, patch: int | None = None) -> Draw:
        """The object at position ``place`` of the batch of ``step``; a function of the seed, the step and ``place``."""
        return draw(
            sources or self.sources,
            (self.seed, step, place),
            inputs=self.given.max_views,
            targets=self.config.targets,
            background=self.given.background,
            input_size=self.model.preset.image_size,
            target_size=self.config.image_size,
            patch=self.config.patch if patch is None else patch,
        ).to(self.model.device)

    def batch(self, step: int, objects: range) -> Sequence[Any]:
        return [(step, place) for place in objects]  # loaded one at a time: a batch of images may not fit in memory

    def losses(self, item: tuple[int, int]) -> dict[str, Tensor]:
        return object_losses(self.model, self.drawn(*item), self.config, self.distance, bfloat16=self.given.bfloat16)

    @torch.no_grad()
    def measures(self) -> dict[str, float]:
        """``surface``: fraction of CHECKED training objects for which the network predicts a surface.

        Raises InputError if the stage renders the surface and there is none: no loss could reach the materials.
        """
        resolution = self.config.resolution or self.model.preset.resolution
        draws = (self.drawn(0, place) for place in range(CHECKED))
        found = [surface(self.model, encode(self.model, one), resolution) is not None for one in draws]
        if self.config.renderer != "volume" and not any(found):
            raise no_surface(f"stage {self.name}")
        return {"surface": sum(found) / CHECKED}

    @torch.no_grad()
    def validation(self, average: dict[str, Tensor]) -> np.ndarray | None:
        """One row per object: reference view, target, rendering, base color, roughness, metallic, normal, lighting."""
        model = Reconstructor(self.model.preset).to(self.model.device)
        model.load_state_dict(average)
        model.eval()
        rows = []
        for one in self.held_out:
            code = encode(model, one)
            shown, _ = renderings(model, code, one, self.config)
            tiles = [views.images[0] * views.masks[0][..., None] for views in (one.inputs, one.targets)]
            if shown:
                rendering = shown[0]
                coverage = (rendering.coverage * rendering.known)[..., None]
                finish = torch.cat([rendering.material[..., 3:], torch.zeros_like(coverage)], -1) * coverage
                normal = 0.5 * (rendering.normal + 1.0) * coverage
                tiles += [rendering.color, rendering.material[..., :3] * coverage, finish, normal]
            else:
                tiles += [torch.zeros_like(tiles[1])] * 4
            light = model.decode_environment(code)[0]
            tiles.append((light / light.mean().clamp(min=1e-6) * 0.3).clamp(0, 1) ** (1 / 2.2))
            rows.append(np.concatenate([_tile(t.clamp(0, 1).cpu().numpy()) for t in tiles], 1))
        return np.concatenate(rows) if rows else None


def no_surface(where: object) -> InputError:
    """The error for a network that predicts no surface."""
    fix = f"start from a longer --stage volume ({TINY['volume'].steps} steps by default)"
    problem = f"expected a network that predicts a surface, got none for {CHECKED} training objects"
    return InputError(where, f"{problem}; {fix}, whose log has the fraction with a surface")


def _tile(values: np.ndarray) -> np.ndarray:
    """``values`` resized to TILE_PIXELS by TILE_PIXELS pixels, nearest neighbor, uint8."""
    rows, columns = (np.arange(TILE_PIXELS) * size // TILE_PIXELS for size in values.shape[:2])
    return (values[rows][:, columns] * 255 + 0.5).astype(np.uint8)
