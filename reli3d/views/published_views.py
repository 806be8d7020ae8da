"""Views preprocessed like the published network's training data, and further options of this network.

The release stores training views as JPEG and preprocesses every input likewise: JPEG round trip, bilinear resize
without antialiasing, mask thresholded at one half after resizing.  The network was trained on such images, so inference
uses the same steps, listed in docs/model.md.
"""

import contextlib
import io

import numpy as np
import torch
from PIL import Image
from torch import Tensor
from torch.nn.functional import interpolate

from reli3d.errors import InputError
from reli3d.views.normalize import normalize
from reli3d.views.views import ViewBatch, Views

JPEG_QUALITY = 95  # with JPEG_CHROMA the defaults of OpenCV's encoder, which the release leaves as they are
JPEG_CHROMA = "4:2:0"
MASK_THRESHOLD = 0.5
BACKGROUNDS = ("auto", "masked", "visible")
CLEAR = 0.02  # alpha below which a pixel is background alone
BACKGROUND_RANGE = 4 / 255  # between the 10th and the 90th percentile; a cut-out's ringing stays near its silhouette


def published_views(views: Views, size: int) -> ViewBatch:
    """All views at ``size`` x ``size`` pixels as the release prepares them; cameras are unchanged.

    The whole image is stretched to the square; colors keep the background; masks are 0 or 1.  8-bit pixels
    are encoded, so colors of 16 bits are rounded first.  Agrees with the published tensors to float32
    rounding (2e-7), masks exactly.  Raises ValueError for a size below 1, or for views that are not on the CPU, where
    the codec runs.
    """
    if size < 1:
        raise ValueError(f"size: expected at least 1, got {size}")
    if views.c2w.device.type != "cpu":
        raise ValueError(f"views: expected views on the CPU, got {views.c2w.device}")
    images, masks, intrinsics = [], [], []
    for image, mask, camera in zip(views.images, views.masks, views.intrinsics.double(), strict=True):
        images.append(_resized(jpeg_round_trip(image), size))
        alpha = _resized(jpeg_round_trip(mask[..., None].expand(-1, -1, 3)), size)[..., 2]
        masks.append((alpha > MASK_THRESHOLD).float())
        height, width = mask.shape
        intrinsics.append(camera * camera.new_tensor([size / width, size / height] * 2))
    cameras = torch.stack(intrinsics).to(views.intrinsics.dtype)
    return ViewBatch(torch.stack(images), torch.stack(masks), views.c2w, cameras)


def jpeg_round_trip(pixels: Tensor) -> Tensor:
    """``pixels (H, W, 3)`` in [0, 1] after encoding and decoding as JPEG, multiples of 1/255, float32."""
    array = np.rint(pixels.numpy().clip(0.0, 1.0) * np.float32(255)).astype(np.uint8)
    buffer = io.BytesIO()
    Image.fromarray(array).save(buffer, "JPEG", quality=JPEG_QUALITY, subsampling=JPEG_CHROMA)
    with Image.open(buffer, formats=("JPEG",)) as decoded:
        return torch.from_numpy(np.asarray(decoded).astype(np.float32) / np.float32(255))


def _resized(pixels: Tensor, size: int) -> Tensor:
    """Bilinear between pixel centers, without filtering: what OpenCV's resize does by default."""
    moved = interpolate(pixels.permute(2, 0, 1)[None], (size, size), mode="bilinear", align_corners=False)
    return moved[0].permute(1, 2, 0)


def hero_first(views: Views, hero: int) -> Views:
    """``views`` with view ``hero`` first and the others in order.  Raises InputError for an index out of range."""
    count = len(views)
    if isinstance(hero, bool) or not isinstance(hero, int) or not 0 <= hero < count:
        raise InputError("hero", f"expected 0 to {count - 1} with {count} views, got {hero}")
    return views if hero == 0 else views.select([hero, *(i for i in range(count) if i != hero)])


def background_shown(views: Views, background: str, *, readable: bool) -> bool:
    """Whether the illumination branch sees the background: never if ``masked``, always if ``visible``, and if
    ``auto`` where the weights were trained to (``readable``) and every view has one.  Raises InputError for another
    word, and for ``visible`` unless ``readable``.
    """
    if background not in BACKGROUNDS:
        raise InputError("background", f"expected {', '.join(BACKGROUNDS)}, got {background}")
    if background == "visible" and not readable:
        raise InputError(
            "background", "expected masked or auto, as only a refinement reads it with these weights, got visible"
        )
    if background != "auto":
        return background == "visible"
    return readable and all(has_background(i, m) for i, m in zip(views.images, views.masks, strict=True))


def has_background(image: Tensor, mask: Tensor) -> bool:
    """Whether ``image (H, W, 3)`` has content outside ``mask (H, W)``: a cut-out has one flat color there."""
    outside = image[mask < CLEAR]
    if len(outside) == 0:
        return False
    low, high = np.percentile(outside.cpu().numpy(), (10, 90), axis=0)
    return bool((high - low).max() > BACKGROUND_RANGE)


def placement_notes(views: Views) -> tuple[str, ...]:
    """Notes on poses that are used as stored: none if the object fills the network's cube, else one line."""
    with contextlib.suppress(InputError):  # masks that do not meet
        if normalize(views, "auto").is_identity():
            return ()
    text = "poses go in as stored, but the object does not sit in the network's cube of half side 0.87 about the origin"
    return (f"{text}; try --normalize auto",)
