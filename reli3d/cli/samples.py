"""The job of ``reli3d-data render``: one sample per call."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from safetensors import SafetensorError
from safetensors.torch import save_file
from torch import Tensor

from reli3d.io.files import replacing
from reli3d.io.gltf_parts import has_material_maps
from reli3d.synthetic.maps import held_out, load_maps, with_lamps
from reli3d.synthetic.procedural import make_object
from reli3d.synthetic.protocol import protocol_sample
from reli3d.synthetic.refinished import RefinishedSurface
from reli3d.synthetic.samples import ObjectSurface, Surface, synthesize
from reli3d.synthetic.scanned import ScannedSurface
from reli3d.synthetic.shapes import ShapeSurface

LAMP_PROBABILITY = 0.45  # of lamps added to a training environment


@dataclass(frozen=True)
class SampleSpec:
    """The options of all samples.  Paths are valid on all machines."""

    maps: Path
    held_out: bool  # held-out maps, without added lamps
    paper: bool  # the paper's protocol
    views: int
    size: int
    meshes: tuple[Path, ...]
    shapes: tuple[Path, ...]
    views_only: bool = False  # without points, for training the 2D U-Net alone
    materials: tuple[Path, ...] = ()  # material sets; if any, materials are exchanged


class SampleJob:
    def __init__(self, spec: SampleSpec):
        torch.set_num_threads(1)
        maps, names = load_maps(spec.maps)
        self.spec = spec
        self.lights = [m for m, h in zip(maps, held_out(names), strict=True) if h == spec.held_out]

    def run(self, folder: object, name: str, target: Path) -> str:
        """Writes the sample ``name``: the seed, in the paper's protocol with the index of the environment."""
        if target.exists():  # written by a worker that crashed later
            return "skipped"
        seed, _, place = name.partition("_")
        sample = self._sample(int(seed), int(place) if place else None)
        try:
            with replacing(target) as temporary:
                save_file(sample, temporary)
        except SafetensorError as error:  # such as a full disk
            raise OSError(f"{target}: cannot be written ({error})") from None
        return "done"

    def _surface(self, seed: int, rng: np.random.Generator) -> Surface:
        """The object of a seed.  rng: stretches and tints meshes, except with the paper's protocol."""
        if self.spec.shapes:
            surface: Surface = ShapeSurface(self.spec.shapes, rng)
        elif self.spec.meshes:
            surface = ScannedSurface(self._mesh(seed), None if self.spec.paper else rng)
        else:
            surface = ObjectSurface(make_object(seed))
        if self.spec.materials:
            texels = 2 * self.spec.size
            return RefinishedSurface(surface, self.spec.materials, rng, measured=self._measured(seed), texels=texels)
        return surface

    def _measured(self, seed: int) -> bool:
        """Whether roughness and metallic values of the object are ground truth and not placeholders of a scan."""
        return not self.spec.meshes or bool(self.spec.shapes) or has_material_maps(self._mesh(seed))

    def _mesh(self, seed: int) -> Path:
        return self.spec.meshes[seed % len(self.spec.meshes)]

    def _sample(self, seed: int, place: int | None) -> dict[str, Tensor]:
        """place: index of the environment in the paper's protocol, None without it."""
        spec, rng = self.spec, np.random.default_rng((seed, 1))
        surface = self._surface(seed, rng)
        if place is not None:
            return protocol_sample(surface, self.lights, seed, place, pbr=self._measured(seed), size=spec.size)
        light = self.lights[int(rng.integers(len(self.lights)))]
        if not spec.held_out and rng.random() < LAMP_PROBABILITY:
            light = with_lamps(light, rng)
        known = bool(spec.materials) or self._measured(seed)
        return synthesize(
            surface, light, rng, size=spec.size, views=spec.views, views_only=spec.views_only, finish_known=known
        )
