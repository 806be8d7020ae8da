"""The published checkpoint from the Hugging Face hub: fetched on request only, then converted.

``huggingface_hub`` (extra ``hub``) obeys ``HF_ENDPOINT``, ``HF_TOKEN``, ``HF_HUB_OFFLINE`` and the proxies.
"""

import errno
import os
import re
import shutil
import sys
from pathlib import Path

from reli3d.nn.presets import OFFICIAL, Preset
from reli3d.nn.weights import WeightsError, convert_checkpoint, official_path

REPOSITORY = "StabilityLabs/ReLi3D"
CHECKPOINT = "reli3d_final.ckpt"
LICENSE = "Stability AI Community License, https://stability.ai/license"
NOTICE = (
    f"The weights of {REPOSITORY} are not part of this package: they come under the {LICENSE}; "
    "using them is accepting it."
)


def fetch_official(*, preset: Preset = OFFICIAL) -> Path:
    """Path of the converted official weights; downloads and converts the checkpoint if there are none.

    A ``reli3d_final.ckpt`` in the same folder is converted without network access and kept; a downloaded one is
    verified by its SHA-256 and removed.  Raises WeightsError if something is missing.
    """
    target = official_path()
    if target.is_file():
        return target
    print(NOTICE, file=sys.stderr)
    placed = target.with_name(CHECKPOINT)
    if placed.is_file():
        convert_checkpoint(placed, target, license=LICENSE, preset=preset)
        return target
    folder = target.with_name("download")
    try:
        checkpoint, etag = _download(folder)
        digest = convert_checkpoint(checkpoint, target, license=LICENSE, preset=preset).metadata["converted_from"]
        shutil.rmtree(folder)
    except WeightsError:
        if not any(folder.rglob("*.incomplete")):
            shutil.rmtree(folder, ignore_errors=True)
        raise
    if re.fullmatch("[0-9a-f]{64}", etag) and etag != digest:
        target.unlink()
        raise WeightsError(checkpoint, f"expected SHA-256 {etag}, got {digest}; fetch it again")
    return target


def _download(folder: Path) -> tuple[Path, str]:
    """The checkpoint in ``folder``, and the tag of its version: for a large file its SHA-256."""
    try:
        from huggingface_hub import errors, get_hf_file_metadata, hf_hub_download, hf_hub_url
    except ImportError:
        raise WeightsError(CHECKPOINT, "reli3d download needs huggingface_hub: pip install 'reli3d[hub]'") from None
    endpoint = os.environ.get("HF_ENDPOINT")
    url = hf_hub_url(REPOSITORY, CHECKPOINT, endpoint=endpoint)
    try:
        path = hf_hub_download(REPOSITORY, CHECKPOINT, local_dir=folder, endpoint=endpoint)
        return Path(path), get_hf_file_metadata(url).etag or ""
    except (errors.HTTPError, errors.EntryNotFoundError, OSError) as error:
        cause = error.__cause__ or error
        status = getattr(getattr(cause, "response", None), "status_code", None)
        page = url.partition("/resolve/")[0]
        text = " ".join(f"{status or ''} {cause}".split())[:160]
        reason = f"cannot be fetched ({text}); check the network and run it again"
        if status in (401, 403):
            reason = f"access refused ({status}): accept the license at {page} and set HF_TOKEN to your token"
        elif status == 404:
            reason = "no such file (404); check HF_ENDPOINT"
        elif isinstance(cause, errors.OfflineModeIsEnabled):
            reason = f"HF_HUB_OFFLINE forbids the download; unset it, or put the file into {folder.parent}"
        elif getattr(cause, "errno", None) == errno.ENOSPC:
            reason = f"no space left in {folder}; it takes 14 GB: set RELI3D_WEIGHTS to a folder on another disk"
        raise WeightsError(url, reason) from None
