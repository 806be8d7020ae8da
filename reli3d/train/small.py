"""The training stages of the small network: ``pixels`` trains the 2D U-Net alone, ``small`` the whole network."""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors.torch import load_file
from torch import Tensor

from reli3d.errors import InputError
from reli3d.nn.local import LocalReconstructor
from reli3d.nn.presets import SMALL
from reli3d.output.preview import preview
from reli3d.pipeline import NoSurface, ReconstructOptions, reconstruct
from reli3d.synthetic.maps import training_maps
from reli3d.train.batches import draw_samples, stored_views
from reli3d.train.losses import PIXEL_TERMS, WEIGHTS, losses, pixel_losses
from reli3d.train.muon import Muon
from reli3d.train.pixels import ViewCache, draw_group, is_pixel_parameter
from reli3d.train.stage import Stage

# They start near zero or without effect, and Adam's step is about the learning rate: AdamW at FAST_RATE times it
FAST_PARAMETERS = (
    *(f"pyramid.says.{k}.1." for k in range(SMALL.pyramid.reading)),
    *("color.4.", "surface.4.", "light.out.", "cost_volume."),
)
FAST_RATE = 10.0
VALIDATION_OBJECTS = 3  # validation objects in the image, reconstructed from one and from four views
LIST_EVERY = 50  # steps after which the folders are listed again: samples may be added during training


@dataclass(frozen=True)
class SmallOptions:
    """Options of :class:`SmallStage`."""

    max_views: int = 6  # upper limit of the random number of input views
    points: int = 2048  # in the volume, of each object; half as many on the surface
    pyramid_rate: float = 1.0  # multiplier of the learning rate of the 2D U-Net, which small batches degrade
    bfloat16: bool = False  # compute dtype of the convolutions


class SmallStage(Stage):
    """The whole network, on points, pixels and lighting of the samples in ``folders``."""

    name = "small"
    weights: dict[str, float] = WEIGHTS
    settings: dict[str, Any] = {}
    optimizer = Muon
    model: LocalReconstructor

    def __init__(
        self,
        model: LocalReconstructor,
        folders: Sequence[Path],
        options: SmallOptions = SmallOptions(),  # noqa: B008 # it is frozen
        *,
        seed: int = 0,
        maps: Path | None = None,
        validation: Path | None = None,
    ):
        """folders: of ``*.safetensors`` from ``reli3d-data``.  maps: environment maps, .npz, for relighting samples.
        validation: folder of held-out samples.  Samples are loaded to the device of ``model``.
        """
        self.model, self.folders, self.seed, self.given = model, tuple(folders), seed, options
        self.lights = training_maps(maps) if maps else None
        self.held_out = sorted(validation.glob("*.safetensors"))[:VALIDATION_OBJECTS] if validation else []
        self._files: list[Path] = []
        paths = {"maps": str(maps or ""), "validation": str(validation or "")}
        self.configuration = {"folders": [str(f) for f in folders], **asdict(options), **paths}
        model.to_compute(torch.bfloat16 if options.bfloat16 else torch.float32)

    def files(self, step: int) -> list[Path]:
        """Files that ``step`` draws from.  Raises InputError if there are none."""
        if step % LIST_EVERY == 0 or not self._files:
            self._files = sorted(path for folder in self.folders for path in folder.glob("*.safetensors"))
        if not self._files:
            raise InputError(", ".join(map(str, self.folders)), "expected *.safetensors files, got none")
        return self._files

    def batch(self, step: int, objects: range) -> Sequence[Any]:
        seeds = [(self.seed, step, k) for k in objects]
        numbers = {"points": self.given.points, "max_views": self.given.max_views}
        return draw_samples(self.files(step), seeds, lights=self.lights, device=self.model.device, **numbers)

    def losses(self, item: Any) -> dict[str, Tensor]:  # a Sample
        return losses(self.model, item)

    def rate_factor(self, parameter: str) -> float:
        last = FAST_RATE if parameter.startswith(FAST_PARAMETERS) else 1.0
        return last * (self.given.pyramid_rate if is_pixel_parameter(parameter) else 1.0)

    def validation(self, average: dict[str, Tensor]) -> np.ndarray | None:
        """Previews of held-out samples, reconstructed from one and four views; None if none has a surface."""
        if not self.held_out:
            return None
        model = LocalReconstructor(self.model.preset)
        model.load_state_dict(average)
        rows, options = [], ReconstructOptions(texture_size=256)
        for path in self.held_out:
            sample, row = load_file(path), []
            for count in (1, 4):
                with suppress(NoSurface):  # early in training
                    asset = reconstruct(stored_views(sample, count), weights=model.eval(), options=options)
                    row.append(preview(asset, stored_views(sample, 4))())
            if row:
                rows.append(np.concatenate(row, 1))
        width = max((row.shape[1] for row in rows), default=0)
        padded = [np.pad(r, ((0, 0), (0, width - r.shape[1]), (0, 0)), constant_values=255) for r in rows]
        return np.concatenate(padded, 0) if padded else None


class PixelStage(SmallStage):
    """The 2D U-Net alone, on the ground-truth maps; images may be 2 or 4 times smaller (``model.pyramid.finest``)."""

    name = "pixels"
    weights = {term: WEIGHTS[term] for term in PIXEL_TERMS}

    def __init__(self, *args: Any, **options: Any):
        super().__init__(*args, **options)
        self._cache = ViewCache(self.model.pyramid.finest, self.model.device)

    def batch(self, step: int, objects: range) -> Sequence[Any]:
        """A single item with all objects: convolutions of small images are faster in large batches."""
        seeds = [(self.seed, step, k) for k in objects]
        return [draw_group(self.files(step), seeds, self._cache, max_views=self.given.max_views)]

    def losses(self, item: Any) -> dict[str, Tensor]:  # a Group
        return pixel_losses(self.model, item)

    def rate_factor(self, parameter: str) -> float:
        return super().rate_factor(parameter) if is_pixel_parameter(parameter) else 0.0

    def validation(self, average: dict[str, Tensor]) -> np.ndarray | None:
        return super().validation(average) if self.model.pyramid.finest == 0 else None
