"""What a process of ``reli3d-data render`` does: one sample a call."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np
    from torch import Tensor

    from reli3d.synthetic.samples import Surface

LAMPS = 0.45  # share of the training lights that get lamps of their own


@dataclass(frozen=True)
class Wanted:
    """What a process needs to make samples.  Paths are those of all machines."""

    maps: Path
    held: bool  # under the maps, and without the lamps, of held-back objects
    paper: bool
    views: int
    size: int
    meshes: tuple[Path, ...]
    shapes: tuple[Path, ...]
    views_only: bool = False  # without points, for the 2D U-Net alone
    materials: tuple[Path, ...] = ()  # material sets; with any, surfaces get finishes of their own


class SampleJob:
    """Makes samples, in one process."""

    def __init__(self, wanted: Wanted):
        import torch

        from reli3d.synthetic.maps import held_back, load_maps

        torch.set_num_threads(1)
        maps, names = load_maps(wanted.maps)
        self.wanted = wanted
        self.lights = [m for m, h in zip(maps, held_back(names), strict=True) if h == wanted.held]

    def run(self, folder: object, name: str, target: Path) -> str:
        """Write the sample ``name``: a seed, by the paper's protocol with the number of a light behind it.

        Raises InputError where the object cannot be made.
        """
        from safetensors import SafetensorError
        from safetensors.torch import save_file

        from reli3d.io.files import replacing

        if target.exists():  # by a worker that crashed after it
            return "skipped"
        seed, _, light = name.partition("_")
        sample = self._paper(int(seed), int(light)) if self.wanted.paper else self._own(int(seed))
        try:
            with replacing(target) as temporary:
                save_file(sample, temporary)
        except SafetensorError as error:  # a full disk, for one
            raise OSError(f"{target}: cannot be written ({error})") from None
        return "done"

    def _surface(self, seed: int, rng: np.random.Generator) -> Surface:
        """The object of a seed.  ``rng`` stretches and tints a mesh, which the paper's protocol leaves as it is."""
        from reli3d.synthetic.dressed import DressedSurface
        from reli3d.synthetic.procedural import make_object
        from reli3d.synthetic.samples import ObjectSurface
        from reli3d.synthetic.scanned import ScannedSurface
        from reli3d.synthetic.shapes import ShapeSurface

        if self.wanted.shapes:
            surface: Surface = ShapeSurface(self.wanted.shapes, rng)
        elif self.wanted.meshes:
            surface = ScannedSurface(self._mesh(seed), None if self.wanted.paper else rng)
        else:
            surface = ObjectSurface(make_object(seed))
        if self.wanted.materials:
            texels = 2 * self.wanted.size
            return DressedSurface(surface, self.wanted.materials, rng, measured=self._measured(seed), texels=texels)
        return surface

    def _measured(self, seed: int) -> bool:
        """Whether roughness and metallic values of the object are a truth, not the placeholders of a scan."""
        from reli3d.io.gltf_parts import has_material_maps

        return not self.wanted.meshes or bool(self.wanted.shapes) or has_material_maps(self._mesh(seed))

    def _mesh(self, seed: int) -> Path:
        return self.wanted.meshes[seed % len(self.wanted.meshes)]

    def _own(self, seed: int) -> dict[str, Tensor]:
        import numpy as np

        from reli3d.synthetic.maps import with_lamps
        from reli3d.synthetic.samples import synthesize

        rng = np.random.default_rng((seed, 1))
        surface = self._surface(seed, rng)
        light = self.lights[int(rng.integers(len(self.lights)))]
        if not self.wanted.held and rng.random() < LAMPS:
            light = with_lamps(light, rng)
        wanted = self.wanted
        known = bool(wanted.materials) or self._measured(seed)
        return synthesize(
            surface, light, rng, size=wanted.size, views=wanted.views, views_only=wanted.views_only, finish_known=known
        )

    def _paper(self, seed: int, light: int) -> dict[str, Tensor]:
        import numpy as np

        from reli3d.synthetic.protocol import protocol_sample

        surface = self._surface(seed, np.random.default_rng((seed, 1)))
        return protocol_sample(surface, self.lights, seed, light, pbr=self._measured(seed), size=self.wanted.size)
