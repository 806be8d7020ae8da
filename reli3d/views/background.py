"""Foreground masks from a segmentation network: ``rembg`` (MIT), an optional dependency.

rembg downloads its network from its release page on first use; this module is used only if the user requests it.
"""

import importlib
import threading
from collections.abc import Callable

from PIL import Image

from reli3d.errors import InputError

NETWORK = "isnet-general-use"  # Qin and others 2022, Highly accurate dichotomous image segmentation; Apache-2.0


class Remover:
    """Segments images, one at a time; loads the network with the first, else raises InputError for ``option``."""

    def __init__(self, option: str = "remove-background"):
        self.option, self.network, self.masks = option, NETWORK, 0
        self._lock = threading.Lock()
        self._cut_out: Callable[[Image.Image], Image.Image] | None = None

    def mask(self, bitmap: Image.Image) -> Image.Image:
        """Mask of mode L with the size of ``bitmap``, soft at the edge of the foreground."""
        with self._lock:
            if self._cut_out is None:
                self._cut_out = _loaded(self.network, self.option)
            self.masks += 1
            return self._cut_out(bitmap if bitmap.mode != "F" else bitmap.point(lambda v: v / 257.0).convert("L"))


def _loaded(network: str, option: str) -> Callable[[Image.Image], Image.Image]:
    try:
        rembg = importlib.import_module("rembg")
    except (ImportError, SystemExit) as error:  # without onnxruntime rembg ends the process
        raise InputError(option, f"expected rembg installed, got none ({error}); pip install 'reli3d[masks]'") from None
    try:
        session = rembg.new_session(network)
    except (OSError, ValueError) as error:  # no network, a full disk; another file than the published one
        expected = f"expected the network {network} of rembg"
        raise InputError(option, f"{expected}, got {error}; it is fetched once, or give masks") from None
    return lambda bitmap: rembg.remove(bitmap.convert("RGB"), session=session, only_mask=True).convert("L")
