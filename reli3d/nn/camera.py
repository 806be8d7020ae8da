"""Embedding of each view's camera matrices, an input of the network.

Camera-to-world matrices are 4x4 in OpenGL axes (+X right, +Y up, looking along -Z); intrinsics are fx, fy, cx, cy in
pixels of the square input, pixel centers at +0.5.
"""

import torch
from torch import Tensor, nn


def camera_vector(c2w: Tensor, intrinsics: Tensor, size: int) -> Tensor:
    """The 25 numbers of a view: camera-to-world row by row, then the 3x3 intrinsics divided by the image size.

    c2w: ``(..., 4, 4)``.  intrinsics: ``(..., 4)`` fx, fy, cx, cy in pixels of an image of ``size`` by ``size``.
    """
    fx, fy, cx, cy = (intrinsics / size).unbind(-1)
    zero, one = torch.zeros_like(fx), torch.ones_like(fx)
    normalized = torch.stack([fx, zero, cx, zero, fy, cy, zero, zero, one], dim=-1)
    return torch.cat([c2w.flatten(-2), normalized], dim=-1)


class CameraEmbedder(nn.Module):
    """One affine map of the 25 camera numbers, :func:`camera_vector`."""

    def __init__(self, width: int):
        super().__init__()
        self.linear = nn.Linear(25, width)

    def forward(self, vector: Tensor) -> Tensor:
        """``(..., 25)`` to ``(..., width)``."""
        return self.linear(vector)
