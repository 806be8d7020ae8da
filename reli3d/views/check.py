"""Checks the cameras of views: a report with the likely mistake in conventions, and a plot of the rig.

With correct cameras, the silhouettes of the visual hull fill the masks.  Otherwise common mistakes are undone one at a
time; the report names the mistake whose correction makes the hull fill the masks.
"""

import math
import os
from dataclasses import replace

import numpy as np
import torch
from PIL import Image, ImageDraw, ImageFilter, ImageOps
from torch import Tensor
from torch.nn.functional import max_pool2d, pad

from reli3d._bridge import full_precision
from reli3d.errors import printable
from reli3d.geometry.camera import project
from reli3d.io.images import write_png
from reli3d.views.normalize import EYE_RESOLUTION, RADIUS, Hull, center_rays, normalize, visual_hull
from reli3d.views.views import Views

MIN_FILLED = 0.8  # fraction of every mask that the hull of right cameras fills; masks a few pixels off still reach 0.9
SURELY_FILLED = 0.97  # mean fraction above which the cameras are accepted
BETTER = 3.0  # an alternative is named where it leaves that many times less of the masks unfilled
UP_MARGIN = 0.1  # mean squared sine by which the up axis must be nearer to the horizon's than others: 18 degrees
NEAR_AXIS = 0.94  # cosine, 20 degrees: an up direction farther from every axis cannot be corrected by --up
INVERTED_BORDER = 0.6  # fraction of the image border inside the mask from which the mask looks inverted


@full_precision
def explain_cameras(views: Views) -> list[str]:
    """One line per view, one line on the up axis unless it is +Y, and last the :func:`verdict` on the cameras."""
    hull, filled = agreement(views)
    c2w, intrinsics = views.c2w.double().cpu(), views.intrinsics.double().cpu()
    rays = center_rays([m.cpu() for m in views.masks], c2w, intrinsics)
    lines = []
    for i, name in enumerate(views.names):
        height, width = views.masks[i].shape
        away = hull.middle() - c2w[i, :3, 3]
        angle = math.degrees(math.acos(max(-1.0, min(1.0, float(away @ rays[i] / away.norm().clamp_min(1e-12))))))
        fov = [math.degrees(2 * math.atan(0.5 * s / float(f))) for s, f in zip((width, height), intrinsics[i, :2])]
        side = "behind the camera" if angle > 90 else f"{angle:.1f} deg off the object's middle"
        cover = float((views.masks[i] > 0.5).float().mean())
        lines.append(
            f"view {i} {printable(name)}: {width} x {height}, field of view {fov[0]:.1f} x {fov[1]:.1f} deg, "
            f"eye {_triple(c2w[i, :3, 3])}, {float(away.norm()):.3g} from the meeting point ({side}), "
            f"mask {100 * cover:.0f} % of the image, hull fills {100 * filled[i]:.0f} % of it"
        )
    axis = up_axis(views.c2w)
    if axis not in (None, "y"):
        lines.append(f"up: the cameras stand upright about {axis}, not y; give --up {axis}")
    return [*lines, _verdict(views, hull, filled)]


@full_precision
def verdict(views: Views) -> str:
    """One line that begins with ``cameras agree``, or with ``suspect`` and names the likely cause, or ``one view``."""
    return _verdict(views, *agreement(views))


@full_precision
def up_axis(c2w: Tensor) -> str | None:
    """The up axis (``y``, ``-z``, ...) under the assumption of upright cameras; None if it is ambiguous.

    c2w: ``(V, 4, 4)``.  The right axis of an upright camera is horizontal: up is the direction most nearly orthogonal
    to all right axes, with the sign of the mean up axis.
    """
    right, above = c2w[:, :3, 0].double().cpu(), c2w[:, :3, 1].double().cpu().mean(0)
    spread, directions = torch.linalg.eigh(right.T @ right / len(right))
    up = directions[:, 0] * torch.sign(directions[:, 0] @ above)
    if float(spread[1] - spread[0]) < UP_MARGIN or float(up @ above) < UP_MARGIN:
        return None
    k = int(up.abs().argmax())
    return ("" if up[k] > 0 else "-") + "xyz"[k] if float(up.abs()[k]) > NEAR_AXIS else None


def _triple(values: Tensor) -> str:
    return "(" + ", ".join(f"{v:.3g}" for v in values.tolist()) + ")"


@full_precision
def agreement(views: Views) -> tuple[Hull, list[float]]:
    """The visual hull, and the fraction of each mask that the hull's silhouette fills; all 0 for an empty hull."""
    hull = visual_hull(views)
    if len(hull.points) == 0:
        return hull, [0.0] * len(views)
    return hull, [_filled(hull, *view) for view in zip(views.masks, views.c2w.double(), views.intrinsics.double())]


def _filled(hull: Hull, mask: Tensor, pose: Tensor, camera: Tensor) -> float:
    pixels, depth = project(hull.points.float(), pose.float().cpu(), camera.float().cpu())
    height, width = mask.shape
    if float(depth.median()) <= 0.0:  # the camera is inside the object
        return 0.0
    footprint = float(camera[:2].max()) * hull.cell / float(depth.median())  # of a cell
    step = max(1, math.ceil(min(footprint, max(height, width))))
    blocks = max_pool2d(pad(mask.cpu(), (0, -width % step, 0, -height % step))[None], step)[0] > 0.5
    inside = (pixels >= 0).all(-1) & (pixels[:, 0] < width) & (pixels[:, 1] < height)
    hit = torch.zeros(blocks.shape, dtype=torch.float32, device="cpu")
    x, y = (pixels[inside] / step).long().unbind(-1)
    hit[y, x] = 1.0
    hit = max_pool2d(hit[None], 3, 1, 1)[0] > 0  # cells and blocks do not line up: allow a block on each side
    return float((hit & blocks).sum() / blocks.sum().clamp_min(1))


def _alternatives(views: Views) -> list[tuple[str, str, Tensor]]:
    """``(mistake, remedy, corrected poses)`` of the common mistakes."""
    c2w = views.c2w
    flip = c2w.new_tensor([1.0, -1.0, -1.0, 1.0])  # of the columns
    given = c2w.double()
    given[:, :3, 3] += given.new_tensor(views.origin)  # as in the folder
    inverse = torch.linalg.inv(given).to(c2w)
    turned = c2w.clone()
    turned[:, :3, :3] = c2w[:, :3, :3].transpose(1, 2)
    flipped = "OpenCV (+Y down, looking along +Z) given, OpenGL expected"
    negate, transpose = "negate the second and third column of each matrix", "transpose the 3x3 blocks"
    quarter = "the images look turned by 90 degrees (an EXIF orientation that was applied or lost?)"
    exchanged = c2w[..., [1, 0, 2, 3]]
    return [
        (f"the camera axes look flipped: {flipped}", negate, c2w * flip),
        ("the matrices look like world-to-camera", "store their inverses", inverse),
        ("the matrices look like world-to-camera in OpenCV axes", f"invert, then {negate}", inverse * flip),
        ("the rotations look transposed (world-to-camera) with camera positions", transpose, turned),
        ("the rotations look transposed and in OpenCV axes", f"{transpose}, then {negate}", turned * flip),
        ("the images look upside down", "turn them by 180 degrees", c2w * c2w.new_tensor([-1.0, -1.0, 1.0, 1.0])),
        (quarter, "store them as they were calibrated", exchanged * c2w.new_tensor([-1.0, 1.0, 1.0, 1.0])),
        (quarter, "store them as they were calibrated", exchanged * c2w.new_tensor([1.0, -1.0, 1.0, 1.0])),
    ]


def _verdict(views: Views, hull: Hull, filled: list[float]) -> str:
    border = min(float((torch.cat([m[0], m[-1], m[:, 0], m[:, -1]]) > 0.5).float().mean()) for m in views.masks)
    if border > INVERTED_BORDER:
        text = f"suspect: the masks look inverted (they cover {100 * border:.0f} % of the image border)"
        return f"{text}; make the object white, the background black"
    if len(views) == 1:
        return _single(views, hull)
    given = sum(filled) / len(filled)
    cause, fix, best = "", "", 1.0 - (1.0 - given) / BETTER
    for what, how, poses in _alternatives(views) if given < SURELY_FILLED else ():
        score = sum(agreement(replace(views, c2w=poses))[1]) / len(views)
        if score >= max(best, MIN_FILLED):
            cause, fix, best = what, how, score
    if cause:
        text = f"suspect: {cause}"
        return f"{text}; {fix} (the hull then fills {100 * best:.0f} % of the masks instead of {100 * given:.0f} %)"
    if min(filled) >= MIN_FILLED:
        low, high = hull.box()
        size = " x ".join(f"{v:.3g}" for v in (high - low).tolist())
        text = f"cameras agree: the visual hull fills at least {100 * min(filled):.0f} % of every mask"
        return f"{text}; its box is {size} about {_triple((low + high) / 2)}; {_scaling(views)}"
    for i in range(len(views) if len(views) > 2 else 0):
        if min(agreement(views.select([j for j in range(len(views)) if j != i]))[1]) >= MIN_FILLED:
            text = f"suspect: view {i} ({printable(views.names[i])}) does not agree with the others"
            return f"{text}, which agree without it; check its camera and mask, or leave it out"
    eyes = views.c2w[:, :3, 3].double()
    if float((eyes - eyes[0]).norm(dim=-1).max()) <= EYE_RESOLUTION * float(eyes.norm(dim=-1).max()):
        text = "suspect: all cameras stand in one point: the views show one side of the object, and no depth"
        return f"{text}; give the positions of the cameras, or one view"
    if len(hull.points) == 0:
        text = "suspect: no point lies inside all masks (the visual hull is empty)"
        return f"{text}: the cameras do not look at a common object, or the masks show different things"
    text = f"suspect: the visual hull fills only {100 * min(filled):.0f} % of a mask"
    return f"{text}: cameras or masks are inaccurate, or the object moved; look at the plot of the rig"


def _single(views: Views, hull: Hull) -> str:
    pose = views.c2w[0].double().cpu()
    if float(pose[:3, 3] @ pose[:3, 2]) < 0:  # positive where the origin lies before an OpenGL camera
        text = "suspect: the camera looks away from the origin: its axes may be flipped (OpenCV given, OpenGL expected)"
        return f"{text}, or its matrix world-to-camera; one view leaves it open"
    if len(hull.points) == 0:
        return "suspect: no point lies inside the mask; check the field of view and the mask"
    return f"one view: nothing to compare it with; the object is taken to be as deep as wide; {_scaling(views)}"


def _scaling(views: Views) -> str:
    similarity = normalize(views)
    if similarity.is_identity():
        return "left as it is for the network"
    return f"scaled by {similarity.scale:.4g} and centered for the network"


PANEL, THUMB, MARGIN = 560, 184, 12
_COLORS = ("#d62728", "#1f77b4", "#2ca02c", "#ff7f0e", "#9467bd", "#17becf", "#e377c2", "#8c564b")


def draw_rig(views: Views, path: str | os.PathLike) -> None:
    """Writes a PNG of the rig: frustums, visual hull and the network's cube from two sides, and thumbnails.

    On the thumbnails, the mask's outline is green, and the hull's cells are red dots.  Raises OSError if writing fails.
    """
    hull, filled = agreement(views)
    c2w, intrinsics = views.c2w.double().cpu(), views.intrinsics.double().cpu()
    target, eyes = hull.middle(), c2w[:, :3, 3]
    reach = max(float((eyes - target).norm(dim=-1).max()), float(eyes.norm(dim=-1).max())) or 1.0
    frustums = [_frustum(c, k, tuple(m.shape), 0.16 * reach) for c, k, m in zip(c2w, intrinsics, views.masks)]
    cube = _cube(views) if len(hull.points) else target[None].numpy()
    spread = np.concatenate([*frustums, cube, np.zeros((1, 3))])
    middle, reach = (spread.min(0) + spread.max(0)) / 2, 0.55 * float((spread.max(0) - spread.min(0)).max())
    columns = (2 * PANEL + MARGIN) // (THUMB + MARGIN)
    rows = -(-len(views) // columns)
    size = (2 * PANEL + 3 * MARGIN, PANEL + 2 * MARGIN + rows * (THUMB + 18 + MARGIN))
    canvas = Image.new("RGB", size, "white")
    titles = ("from above: x right, z down", "from the front: x right, y up")
    for panel, (title, down) in enumerate(zip(titles, ((2, 1.0), (1, -1.0)))):
        corner = (MARGIN + panel * (PANEL + MARGIN), MARGIN)
        canvas.paste(_panel(views, hull, middle, reach, frustums, title, down), corner)
    for i in range(len(views)):
        at = (MARGIN + i % columns * (THUMB + MARGIN), PANEL + 2 * MARGIN + i // columns * (THUMB + 18 + MARGIN))
        canvas.paste(_thumbnail(views, hull, i), at)
        label = f"{i} {os.path.basename(views.names[i])[:18]}  {100 * filled[i]:.0f} %"
        ImageDraw.Draw(canvas).text((at[0], at[1] + THUMB + 2), latin(label), fill=_COLORS[i % len(_COLORS)])
    write_png(path, np.asarray(canvas))


def latin(text: str) -> str:
    return text.encode("latin-1", "replace").decode("latin-1")  # Pillow's built-in font has no more


def _frustum(pose: Tensor, camera: Tensor, shape: tuple[int, ...], length: float) -> np.ndarray:
    """``(5, 3)`` world points: the eye and the four image corners at depth ``length``."""
    corners = camera.new_tensor([[0, 0], [1, 0], [1, 1], [0, 1]]) * camera.new_tensor([shape[1], shape[0]])
    x, y = ((corners - camera[2:]) / camera[:2]).unbind(-1)
    local = length * torch.stack([x, -y, -torch.ones_like(x)], -1)
    return torch.cat([pose[:3, 3][None], local @ pose[:3, :3].T + pose[:3, 3]]).numpy()


def _cube(views: Views) -> np.ndarray:
    """``(8, 3)`` corners of the network's cube in the frame of the cameras."""
    corners = torch.cartesian_prod(*[torch.tensor([-RADIUS, RADIUS], dtype=torch.float64, device="cpu")] * 3)
    return normalize(views).inverse().apply(corners).numpy()


def _panel(views, hull, middle, reach, frustums, title, vertical) -> Image.Image:
    """The rig with x to the right.  vertical: world axis along the image's rows, and its sign downwards."""
    down, sign = vertical
    bitmap = Image.new("RGB", (PANEL, PANEL), "#f4f4f4")
    draw, zoom = ImageDraw.Draw(bitmap), 0.5 * PANEL / reach

    def at(points: np.ndarray) -> list[list[float]]:
        return (PANEL / 2 + (points.reshape(-1, 3) - middle)[:, [0, down]] * zoom * (1, sign)).tolist()

    if len(hull.points):
        points = hull.points.numpy()
        order = np.argsort(points[:, 3 - down])  # seen from the positive end of the third axis
        shade = np.linspace(90, 190, len(order)).astype(int)[::-1]
        half = max(1.0, 0.5 * hull.cell * zoom)
        for (x, y), gray in zip(at(points[order]), shade):
            draw.rectangle((x - half, y - half, x + half, y + half), fill=(int(gray),) * 2 + (int(gray) + 30,))
        xs, ys = zip(*at(_cube(views)))
        draw.rectangle((min(xs), min(ys), max(xs), max(ys)), outline="#606060")
    ((x, y),) = at(np.zeros((1, 3)))
    draw.line((x - 5, y, x + 5, y), fill="black")
    draw.line((x, y - 5, x, y + 5), fill="black")
    for i, frustum in enumerate(frustums):
        color_of, (eye, *corners) = _COLORS[i % len(_COLORS)], at(frustum)
        for k, corner in enumerate(corners):
            draw.line((*eye, *corner), fill=color_of, width=2)
            draw.line((*corners[k - 1], *corner), fill=color_of, width=4 if k == 1 else 2)  # bold: the top
        draw.line((*eye, *at(hull.middle().numpy())[0]), fill="#c8c8c8")
        draw.text((eye[0] + 4, eye[1] + 4), str(i), fill=color_of)
    draw.text((6, 4), f"{title}; square: the network's cube, cross: origin", fill="black")
    scale = 10 ** math.floor(math.log10(reach))
    draw.line((8, PANEL - 12, 8 + scale * zoom, PANEL - 12), fill="black", width=2)
    draw.text((10, PANEL - 26), f"{scale:g}", fill="black")
    return bitmap


def _thumbnail(views: Views, hull: Hull, i: int) -> Image.Image:
    height, width = views.masks[i].shape
    zoom = THUMB / max(height, width)
    size = (max(1, round(width * zoom)), max(1, round(height * zoom)))
    image, mask = (
        Image.fromarray((values[i].cpu().numpy() * 255).astype(np.uint8)).resize(size, Image.Resampling.BOX)
        for values in (views.images, views.masks)
    )
    pixels = np.array(image)
    inside, near = (np.asarray(m) > 127 for m in (mask, mask.filter(ImageFilter.MaxFilter(3))))
    if len(hull.points):
        at, _ = project(hull.points[::7].float(), views.c2w[i].cpu(), views.intrinsics[i].cpu())
        x, y = (at * zoom).floor().long().unbind(-1)
        keep = (x >= 0) & (y >= 0) & (x < size[0]) & (y < size[1])
        pixels[y[keep].numpy(), x[keep].numpy()] = (220, 30, 30)
    pixels[near & ~inside] = (0, 200, 0)
    return ImageOps.pad(Image.fromarray(pixels), (THUMB, THUMB), color="white")
