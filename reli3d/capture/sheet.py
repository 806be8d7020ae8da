"""The contact sheet of a capture: masks over the images, and cameras and points from above and from the side."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import cv2
import numpy as np
from PIL import Image, ImageDraw

from reli3d.capture.mapping import View
from reli3d.views.check import latin

THUMBNAIL, PANEL, MARGIN, COLUMNS = 160, 480, 8, 6
MOST_POINTS = 4000


def contact_sheet(
    images: Sequence[tuple[str, np.ndarray, np.ndarray, View]],
    points: np.ndarray,
    eyes: np.ndarray,
    to_map: Callable[[np.ndarray], np.ndarray],
    lines: Sequence[str],
) -> Image.Image:
    """The sheet.  images: name, pixels, mask and pinhole view.  points ``(P, 3)``, eyes ``(V, 3)``: in the frame of the
    object folder, which ``to_map`` takes back to that of the views.  lines: at most two, written on top.
    """
    rows = -(-len(images) // COLUMNS)
    width = max(2 * PANEL + 3 * MARGIN, COLUMNS * (THUMBNAIL + MARGIN) + MARGIN)
    sheet = Image.new("RGB", (width, PANEL + 60 + rows * (THUMBNAIL + 22)), "white")
    draw = ImageDraw.Draw(sheet)
    draw.text((MARGIN, 4), "\n".join(lines), fill="black")
    some = points[:: max(1, len(points) // MOST_POINTS)]
    sheet.paste(_panel("from above", some[:, [0, 2]], eyes[:, [0, 2]]), (MARGIN, 36))
    sheet.paste(_panel("from the side", some[:, [0, 1]] * [1, -1], eyes[:, [0, 1]] * [1, -1]), (2 * MARGIN + PANEL, 36))
    for k, (name, pixels, mask, view) in enumerate(images):
        at = MARGIN + k % COLUMNS * (THUMBNAIL + MARGIN), PANEL + 50 + k // COLUMNS * (THUMBNAIL + 22)
        sheet.paste(_thumbnail(pixels, mask, view, to_map(some[::8])), at)
        draw.text((at[0], at[1] + THUMBNAIL + 2), latin(name[-24:]), fill="black")
    return sheet


def _panel(title: str, points: np.ndarray, eyes: np.ndarray) -> Image.Image:
    panel = Image.new("RGB", (PANEL, PANEL), "#f4f4f4")
    draw = ImageDraw.Draw(panel)
    both = np.concatenate([points, eyes, np.zeros((1, 2))])
    middle, reach = (both.min(0) + both.max(0)) / 2, 0.55 * float(np.ptp(both, axis=0).max()) + 1e-9
    place = lambda p: ((p - middle) / reach * 0.5 + 0.5) * PANEL
    for x, y in place(points):
        draw.point((x, y), fill="#5070a0")
    for k, (x, y) in enumerate(place(eyes)):
        draw.ellipse((x - 3, y - 3, x + 3, y + 3), fill="#d62728")
        draw.text((x + 4, y - 5), str(k), fill="#606060")
    draw.text((6, 4), title, fill="black")
    return panel


def _thumbnail(pixels: np.ndarray, mask: np.ndarray, view: View, points: np.ndarray) -> Image.Image:
    scale = THUMBNAIL / max(pixels.shape[:2])
    size = max(1, round(pixels.shape[1] * scale)), max(1, round(pixels.shape[0] * scale))
    small = cv2.resize(pixels, size, interpolation=cv2.INTER_AREA)
    inside = (cv2.resize(mask, size, interpolation=cv2.INTER_AREA) > 127).astype(np.uint8)
    small[inside == 0] = small[inside == 0] // 2 + 96
    at, depth = view.project(points)
    for x, y in np.rint(at[depth > 0] * scale).astype(int):
        if 0 <= x < size[0] and 0 <= y < size[1]:
            small[y, x] = (230, 40, 40)
    outline = cv2.dilate(inside, np.ones((3, 3), np.uint8)) - inside
    small[outline > 0] = (0, 200, 0)
    canvas = Image.new("RGB", (THUMBNAIL, THUMBNAIL), "white")
    canvas.paste(Image.fromarray(small), ((THUMBNAIL - size[0]) // 2, (THUMBNAIL - size[1]) // 2))
    return canvas
