"""RENI++ latents of the lighting of training samples, the ground truth of the latent loss."""

import hashlib
from collections.abc import Callable, Sequence
from pathlib import Path

from safetensors import safe_open
from safetensors.torch import save_file
from torch import Tensor

from reli3d.errors import InputError, shown
from reli3d.io.files import replacing
from reli3d.nn.model import Reconstructor
from reli3d.nn.reni import EnvironmentDecoder
from reli3d.nn.reni_fit import fit_latent
from reli3d.render.latlong import quarter_turn
from reli3d.train.checkpoint import check_shapes, load
from reli3d.train.light_prior import LightPriorStage

Latents = dict[str, tuple[Tensor, Tensor]]  # of a file's stem: (L, 3) and ()


def load_prior(model: Reconstructor, path: Path) -> None:
    """Loads the decoder of a checkpoint of stage ``light_prior`` into ``model`` and freezes it; or InputError."""
    state = load(path)
    if state["stage"] != LightPriorStage.name:
        raise InputError(path, f"expected a checkpoint of stage light_prior, got one of stage {shown(state['stage'])}")
    decoder = {k.removeprefix("decoder."): v for k, v in state["average"].items() if k != "latents"}
    check_shapes(path, decoder, model.environment)
    model.environment.load_state_dict(decoder)
    model.environment.requires_grad_(False)


def fitted(
    decoder: EnvironmentDecoder,
    files: Sequence[Path],
    cache: Path,
    *,
    steps: int = 200,
    progress: Callable[[str], None] = lambda line: None,
) -> Latents:
    """Latents and strength of the lighting of samples by the stem of the file.  cache: earlier results, updated."""
    digest = hashlib.sha256(str(steps).encode())
    for name, value in decoder.state_dict().items():
        digest.update(name.encode() + value.cpu().numpy().tobytes())
    known: dict[str, Tensor] = {}
    if cache.exists():
        with safe_open(cache, "pt") as file:
            if (file.metadata() or {}).get("decoder") == digest.hexdigest():
                known = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 - no iterable
    stored = {}
    for path in files:
        with safe_open(path, "pt") as file:
            stored[path.stem] = file.get_tensor("environment")
    keys = {stem: hashlib.sha256(light.numpy().tobytes()).hexdigest() for stem, light in stored.items()}
    missing = [stem for stem, key in keys.items() if f"{key}.latent" not in known]
    for done, stem in enumerate(missing):
        light = quarter_turn(stored[stem].float(), -1)  # stored with -Z at the horizontal center
        latent, strength, error = fit_latent(decoder, light.to(decoder.sample_directions.device), steps=steps)
        known[f"{keys[stem]}.latent"], known[f"{keys[stem]}.strength"] = latent.cpu(), strength.cpu()
        if done % 16 == 15:
            progress(f"latents: {done + 1} of {len(missing)} lights, the last with error {error:.3f}")
    if missing:
        cache.parent.mkdir(parents=True, exist_ok=True)
        with replacing(cache) as temporary:
            save_file({k: v.contiguous() for k, v in known.items()}, temporary, {"decoder": digest.hexdigest()})
    return {stem: (known[f"{key}.latent"], known[f"{key}.strength"]) for stem, key in keys.items()}
