"""A self-contained HTML page that shows a reconstruction in a browser, offline."""

import base64
import html
import io
import json
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from PIL import Image, WebPImagePlugin
from torch import Tensor

import reli3d
from reli3d.errors import printable
from reli3d.geometry.mesh import Mesh
from reli3d.geometry.rays import RayScene
from reli3d.io.hdr import environment_bytes
from reli3d.render.environment import Environment
from reli3d.render.lights import LIGHTS
from reli3d.render.transfer import blocked_transfer, light_harmonics
from reli3d.views.views import Views

PARTS = Path(reli3d.__file__).parent / "assets" / "viewer"
MAX_IMAGE_PIXELS = 640  # along the longer side of an input image: 16 take less than a megabyte
QUALITY, METHOD = 80, 2  # of their WebP: method 4 takes twice as long for 7 % less
DEFLATE_LEVEL = 1  # 2.3 times smaller; higher levels gain about 10 %
MIN_TRANSFER = 1e-20  # against division by zero if nothing is blocked


@dataclass(frozen=True)
class Shown:
    """A GLB file and the :func:`shadow` of its mesh."""

    glb: bytes
    shadow: Mapping[str, str | float]


def viewer_page(
    name: str, meshes: Mapping[str, Shown], light: Tensor, middle: Tensor, radius: float, stops: Sequence[dict]
) -> str:
    """HTML page of ``meshes``, by name, under ``light (H, 2H, 3)`` and two built-in environments.

    middle ``(3,)``, radius: of the object, for the camera.  stops: from :func:`photograph_stops`.
    """
    lights = {"estimated light": light, **{k: make().radiance for k, make in LIGHTS.items()}}
    data = {
        "name": name,
        "meshes": [{"name": k, "glb": _base64(v.glb), **v.shadow} for k, v in meshes.items()],
        "lights": [
            {"name": k, "hdr": _base64(environment_bytes(v)), "harmonics": light_harmonics(Environment(v)).T.tolist()}
            for k, v in lights.items()
        ],
        "views": list(stops),
        "middle": middle.tolist(),
        "radius": radius,
    }
    page = (PARTS / "viewer.html").read_text(encoding="utf-8")
    fillings = {
        "title": html.escape(name),
        "data": json.dumps(data).replace("<", "\\u003c"),
        "three": (PARTS / "three.min.js").read_text(encoding="utf-8"),
        "viewer": (PARTS / "viewer.js").read_text(encoding="utf-8"),
    }
    head, *rest = page.split("{{")  # one pass: inserted text is not searched
    return head + "".join(fillings[part.split("}}", 1)[0]] + part.split("}}", 1)[1] for part in rest)


def photograph_stops(views: Views) -> list[dict]:
    """Camera stops at the input views; images are downsampled to ``MAX_IMAGE_PIXELS``, with the masks as alpha."""
    stops = []
    for i in range(len(views)):
        height, width = views.masks[i].shape
        rgba = np.concatenate([views.images[i].cpu().numpy(), views.masks[i].cpu().numpy()[..., None]], -1)
        scale = min(1.0, MAX_IMAGE_PIXELS / max(width, height))
        size = (max(1, round(width * scale)), max(1, round(height * scale)))
        bitmap = Image.fromarray((rgba * 255 + 0.5).astype(np.uint8)).resize(size, Image.Resampling.BOX)
        data = io.BytesIO()
        # an unregistered name would make Pillow import all formats
        bitmap.save(data, WebPImagePlugin.WebPImageFile.format, quality=QUALITY, method=METHOD)
        fx, fy, cx, cy = views.intrinsics[i].tolist()
        sx, sy = size[0] / width, size[1] / height
        stops.append(
            {
                "name": printable(views.names[i]),
                "image": f"data:image/webp;base64,{_base64(data.getvalue())}",
                "width": size[0],
                "height": size[1],
                "c2w": views.c2w[i].tolist(),
                "intrinsics": [fx * sx, fy * sy, cx * sx, cy * sy],
            }
        )
    return stops


def _base64(data: bytes) -> str:
    return base64.b64encode(data).decode()


def shadow(mesh: Mesh, scene: RayScene | None = None) -> dict[str, str | float]:
    """Self-shadowing of the vertices as spherical harmonics, deflated, 16 bytes each, in steps of ``largest`` / 127."""
    blocked = blocked_transfer(mesh, scene=scene).cpu()
    largest = float(blocked.abs().amax()) if blocked.numel() else 0.0
    steps = (blocked * (127.0 / max(largest, MIN_TRANSFER))).round().to(torch.int8)
    return {"blocked": _base64(zlib.compress(steps.numpy().tobytes(), DEFLATE_LEVEL)), "largest": largest}
