"""Weights in files: safetensors whose manifest is checked before anything is allocated; published files converted.

A file of ours carries preset and license in its header.  Pickles are only read by torch's restricted reader.
"""

import contextlib
import hashlib
import os
import pickle
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from reli3d.errors import InputError
from reli3d.io.files import file_size, replacing
from reli3d.nn.local import LocalReconstructor
from reli3d.nn.model import Reconstructor
from reli3d.nn.presets import OFFICIAL, LocalPreset, Preset, from_json, to_json
from reli3d.nn.published import CHECKPOINT_PREFIX, UNUSED, our_key

# of torch.load for a cut, changed or other file, and pickle.UnpicklingError
BROKEN_TORCH_FILE = (RuntimeError, ValueError, EOFError, KeyError, OSError)
FORMAT = "reli3d 1"
SMALL = Path(__file__).parents[1] / "assets" / "weights" / "small.safetensors"
LARGE = 1 << 30  # bytes; hashing less takes about a second
_DTYPES = {"F64": torch.float64, "F32": torch.float32, "F16": torch.float16, "BF16": torch.bfloat16}
BFLOAT16_INSTRUCTIONS = ("avx512_bf16", "amx_bf16", "bf16")  # as torch.cpu names them: AMD and Intel, Intel, ARM


AnyPreset = Preset | LocalPreset
Network = Reconstructor | LocalReconstructor
Trunk = torch.dtype | Literal["auto"] | None


def network(preset: AnyPreset) -> Network:
    """The network of a preset, its parameters ready for training from scratch."""
    return LocalReconstructor(preset) if isinstance(preset, LocalPreset) else Reconstructor(preset)


class WeightsError(InputError):
    """A weights file cannot be used; the message is one line with the file and the reason."""


@dataclass(frozen=True)
class Stored:
    dtype: torch.dtype
    shape: tuple[int, ...]


@dataclass(frozen=True)
class Manifest:
    """Tensors and metadata in the header of a safetensors file."""

    path: str
    tensors: dict[str, Stored]
    metadata: dict[str, str]  # of files in our format: format, preset, licence (spelled so in files) and other entries

    @property
    def license(self) -> str:
        return self.metadata.get("licence", "not stated")

    def preset(self) -> AnyPreset:
        """The preset in the file's header.  Raises WeightsError where there is none."""
        try:
            return from_json(self.metadata["preset"])
        except KeyError:
            raise WeightsError(self.path, "has no preset in its header; it is not a file of this package") from None
        except ValueError as error:
            raise WeightsError(self.path, str(error)) from None


def sha256(path: str | os.PathLike) -> str:
    """Hash of a file's bytes in hexadecimal."""
    _size(path)
    digest = hashlib.sha256()
    with open(path, "rb") as file:
        while block := file.read(1 << 20):
            digest.update(block)
    return digest.hexdigest()


def known_sha256(path: str | os.PathLike) -> str:
    """:func:`sha256`, cached for large files in ``<file>.sha256`` with size and modification time; for records only."""
    path = Path(path)
    if _size(path) < LARGE:
        return sha256(path)
    note, about = path.with_name(path.name + ".sha256"), f"{path.stat().st_size} {path.stat().st_mtime_ns}"
    with contextlib.suppress(OSError, ValueError):
        digest, _, rest = note.read_text().strip().partition(" ")
        if rest == about and re.fullmatch("[0-9a-f]{64}", digest):
            return digest
    digest = sha256(path)
    with contextlib.suppress(OSError), replacing(note) as temporary:  # not cached in a read-only folder
        Path(temporary).write_text(f"{digest} {about}\n")
    return digest


def read_manifest(path: str | os.PathLike) -> Manifest:
    """The header of a safetensors file; WeightsError unless the file is whole and all tensors are of floating point."""
    _size(path)
    with open(path, "rb") as file:
        if file.read(4) == b"PK\x03\x04":
            raise WeightsError(path, "is a torch checkpoint, expected safetensors; convert it first, see docs/model.md")
    try:
        with safe_open(path, "pt") as opened:
            metadata, names = opened.metadata() or {}, opened.keys()
            entries = {name: opened.get_slice(name) for name in names}
            stored = {name: (entry.get_dtype(), tuple(entry.get_shape())) for name, entry in entries.items()}
    except (SafetensorError, OSError) as error:
        reason = " ".join(str(error).split())[:160]
        raise WeightsError(path, f"is not a safetensors file, or it is cut off ({reason}); fetch it again") from None
    for name, (dtype, _) in stored.items():
        if dtype not in _DTYPES:
            raise WeightsError(path, f"{name}: expected floating-point values, got {dtype}")
    return Manifest(os.fspath(path), {name: Stored(_DTYPES[d], shape) for name, (d, shape) in stored.items()}, metadata)


def _size(path: str | os.PathLike) -> int:
    try:
        return file_size(path)
    except InputError as error:
        raise WeightsError(path, str(error).split(": ", 1)[1]) from None


def unallocated(preset: AnyPreset) -> Network:
    """The network on the meta device."""
    with torch.device("meta"):
        return network(preset).float()  # whatever the default dtype is


def shapes(preset: AnyPreset) -> dict[str, tuple[int, ...]]:
    """Name and shape of every stored tensor of the network; allocates nothing."""
    return _shapes(unallocated(preset).state_dict())


def _shapes(tensors: Mapping[str, Tensor | Stored]) -> dict[str, tuple[int, ...]]:
    return {name: tuple(value.shape) for name, value in tensors.items()}


def check_keys(where: object, got: Mapping[str, tuple[int, ...]], expected: Mapping[str, tuple[int, ...]]) -> None:
    """Raise WeightsError where names or shapes differ; the text counts them and names the first."""
    missing, extra = sorted(expected.keys() - got.keys()), sorted(got.keys() - expected.keys())
    wrong = sorted(name for name in expected.keys() & got.keys() if tuple(got[name]) != tuple(expected[name]))
    if missing:
        raise WeightsError(where, f"lacks {len(missing)} of {len(expected)} tensors, first {missing[0]}")
    if extra:
        raise WeightsError(where, f"has {len(extra)} tensors that the preset does not know, first {extra[0]}")
    if wrong:
        name = wrong[0]
        found = f"expected shape {tuple(expected[name])}, got {tuple(got[name])}"
        raise WeightsError(where, f"{name}: {found}" + (f", and {len(wrong) - 1} more" if len(wrong) > 1 else ""))


def official_path() -> Path:
    """Path of the converted official weights: in the folder ``RELI3D_WEIGHTS``, default ``~/.cache/reli3d``."""
    return Path(os.environ.get("RELI3D_WEIGHTS") or Path.home() / ".cache" / "reli3d") / "official.safetensors"


def locate(weights: str | os.PathLike) -> Path:
    """File of the weights called ``small`` or ``official``, or of a path; nothing is fetched.  Raises WeightsError."""
    path, fix = Path(weights), "check the path"
    if os.fspath(weights) == "small":
        path, fix = SMALL, "install the package again"
    elif os.fspath(weights) == "official":
        path = official_path()
        fix = "fetch them with reli3d download (about 7 GB, Stability AI Community License), or give a converted file"
    if not path.is_file():
        raise WeightsError(path, f"no such file of weights; {fix}")
    return path


def load_model(weights: str | os.PathLike, device: torch.device | str = "cpu", *, trunk: Trunk = None) -> Network:
    """The network of :func:`locate`'s file, see :func:`load`.  Raises WeightsError."""
    return load(locate(weights), trunk=trunk, device=device)[0]


def default_trunk(preset: AnyPreset, device: torch.device | str) -> torch.dtype:
    """bfloat16 for the published sizes on CUDA, whose matrix units are made for it; float32 everywhere else."""
    return torch.bfloat16 if preset.name == "official" and torch.device(device).type == "cuda" else torch.float32


def fastest_dtype(device: torch.device | str) -> torch.dtype:
    """bfloat16 if ``device`` multiplies matrices of bfloat16 in hardware, else float32, which is then faster."""
    if torch.device(device).type == "cuda":
        able = torch.cuda.is_bf16_supported(including_emulation=False)
    else:
        found: Mapping[str, bool] = getattr(torch.cpu, "get_capabilities", dict)()  # not in every supported torch
        able = any(found.get(name, False) for name in BFLOAT16_INSTRUCTIONS)
    return torch.bfloat16 if able else torch.float32


def load(
    path: str | os.PathLike,
    preset: AnyPreset | None = None,
    *,
    trunk: Trunk = None,
    device: torch.device | str = "cpu",
    expected_sha256: str | None = None,
) -> tuple[Network, Manifest]:
    """The network in a safetensors file, in evaluation mode, and the file's manifest.

    preset: expected architecture; default the one in the header.  trunk: dtype of the trunk's parameters, or compute
    dtype of the small network's convolutions; default :func:`default_trunk`, ``auto`` is :func:`fastest_dtype`.  All
    other parameters are float32.  Everything is checked before anything is allocated.  Raises WeightsError.
    """
    manifest = read_manifest(path)
    preset = preset or manifest.preset()
    model = unallocated(preset)
    check_keys(path, _shapes(manifest.tensors), _shapes(model.state_dict()))
    if expected_sha256 is not None:
        found = sha256(path)
        if found != expected_sha256:
            raise WeightsError(path, f"expected SHA-256 {expected_sha256}, got {found}; fetch it again")
    if trunk == "auto":
        trunk = fastest_dtype(device)
    if isinstance(preset, LocalPreset) and trunk not in (None, torch.float32, torch.bfloat16):
        raise WeightsError(path, f"expected float32 or bfloat16 for the network of convolutions, got {trunk}")
    model.to_compute(trunk or default_trunk(preset, device))
    dtypes = {name: value.dtype for name, value in model.state_dict().items()}
    model.load_state_dict(read_tensors(manifest, dtypes, device), strict=True, assign=True)
    return model.eval(), manifest


def read_tensors(
    manifest: Manifest, dtypes: Mapping[str, torch.dtype], device: torch.device | str = "cpu"
) -> dict[str, Tensor]:
    """The tensors named in ``dtypes``, converted to these; on a CPU memory-mapped where nothing changes."""
    with safe_open(manifest.path, "pt") as opened:
        return {name: opened.get_tensor(name).to(device, dtype) for name, dtype in dtypes.items()}


def save(
    path: str | os.PathLike,
    model: Network,
    *,
    license: str,
    dtype: torch.dtype = torch.float16,
    metadata: Mapping[str, str] | None = None,
) -> Manifest:
    """Writes parameters as ``dtype``, preset and license, whole or not at all; WeightsError unless all are finite."""
    parameters = {name for name, _ in model.named_parameters()}
    state = {k: v.detach().to("cpu", dtype if k in parameters else v.dtype) for k, v in model.state_dict().items()}
    for name, value in state.items():
        if not torch.isfinite(value).all():
            raise WeightsError(path, f"{name}: expected finite values in {dtype}; nothing was written")
    header = {"format": FORMAT, "preset": to_json(model.preset), "licence": license, **(metadata or {})}
    write(path, state, header)
    return read_manifest(path)


def write(path: str | os.PathLike, state: Mapping[str, Tensor], metadata: Mapping[str, str]) -> None:
    """Write CPU tensors as safetensors, whole or not at all."""
    with replacing(path) as temporary:
        save_file({name: value.contiguous() for name, value in state.items()}, temporary, dict(metadata))


def convert_checkpoint(
    source: str | os.PathLike, target: str | os.PathLike, *, license: str, preset: Preset = OFFICIAL
) -> Manifest:
    """Turn a published training checkpoint into a safetensors file of ours, float32 as it is.

    Only torch's restricted reader touches the pickle: no code is run.  Raises WeightsError, and then leaves no file.
    """
    state = published_state(read_checkpoint(source), source)
    check_keys(source, _shapes(state), shapes(preset))
    header = {"format": FORMAT, "preset": to_json(preset), "licence": license, "converted_from": sha256(source)}
    write(target, state, header)
    return read_manifest(target)


def read_checkpoint(path: str | os.PathLike) -> dict[str, Tensor]:
    """Tensors of the training system in a Lightning checkpoint, by their published names.  Raises WeightsError."""
    _size(path)
    try:
        content = torch.load(path, weights_only=True, mmap=True, map_location="cpu")
    except pickle.UnpicklingError as error:
        reason = " ".join(str(error).split()).split(". ")[-1][:160]
        raise WeightsError(path, f"holds more than tensors and is rejected, nothing was run ({reason})") from None
    except BROKEN_TORCH_FILE as error:
        reason = str(error).splitlines()[0][:160] if str(error) else type(error).__name__
        raise WeightsError(path, f"is not a torch checkpoint, or it is cut off ({reason}); fetch it again") from None
    state = content.get("state_dict") if isinstance(content, dict) else None
    if not isinstance(state, dict) or not all(isinstance(k, str) and isinstance(v, Tensor) for k, v in state.items()):
        raise WeightsError(path, "expected tensors under state_dict; it is not a training checkpoint")
    return {k[len(CHECKPOINT_PREFIX) :]: v for k, v in state.items() if k.startswith(CHECKPOINT_PREFIX)}


def published_state(published: Mapping[str, Tensor], where: object) -> dict[str, Tensor]:
    """Tensors by our names from published ones.  Raises WeightsError for an unknown name or unequal aliases."""
    state: dict[str, Tensor] = {}
    for name, value in published.items():
        if name.startswith(UNUSED):
            continue
        ours = our_key(name)
        if ours is None:
            raise WeightsError(where, f"{name}: not a tensor of the published model")
        if value.dtype not in _DTYPES.values():
            raise WeightsError(where, f"{name}: expected floating-point values, got {value.dtype}")
        other = state.setdefault(ours, value)
        if other is not value and not (other.data_ptr() == value.data_ptr() or torch.equal(other, value)):
            raise WeightsError(where, f"{name}: expected the values of the same parameter's other name")
    return state
