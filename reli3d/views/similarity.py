"""Similarity transforms between frames: a rotation, one scale and a translation."""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from reli3d._bridge import full_precision
from reli3d.errors import InputError

UP = {  # rows of the rotation that carries an axis to +Y
    "y": [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
    "-y": [[1, 0, 0], [0, -1, 0], [0, 0, -1]],
    "x": [[0, -1, 0], [1, 0, 0], [0, 0, 1]],
    "-x": [[0, 1, 0], [-1, 0, 0], [0, 0, 1]],
    "z": [[1, 0, 0], [0, 0, 1], [0, -1, 0]],
    "-z": [[1, 0, 0], [0, 0, -1], [0, 1, 0]],
}


@dataclass(frozen=True)
class Similarity:
    """``x -> scale * rotation @ x + translation``; float64."""

    scale: float
    rotation: Tensor  # (3, 3)
    translation: Tensor  # (3,)

    @staticmethod
    def without_rotation(translation: Tensor, scale: float = 1.0) -> "Similarity":
        """``x -> scale * x + translation``; translation: float64, on the CPU."""
        return Similarity(scale, torch.eye(3, dtype=torch.float64, device="cpu"), translation)

    @staticmethod
    def identity() -> "Similarity":
        return Similarity.without_rotation(torch.zeros(3, dtype=torch.float64, device="cpu"))

    def matrix(self) -> Tensor:
        """``(4, 4)`` float64 matrix on column vectors."""
        rows = torch.cat([self.scale * self.rotation, self.translation[:, None]], -1)
        return torch.cat([rows, rows.new_tensor([[0.0, 0.0, 0.0, 1.0]])])

    @full_precision
    def apply(self, points: Tensor) -> Tensor:
        """Transformed ``points (..., 3)``, in their dtype and on their device.  Gradients reach the points."""
        return self.scale * points @ self.rotation.to(points).T + self.translation.to(points)

    def of_cameras(self, c2w: Tensor) -> Tensor:
        """Rigid camera-to-world matrices ``(..., 4, 4)`` of transformed cameras.  Gradients reach ``c2w``."""
        exact = c2w.double()
        rotation = self.rotation.to(exact) @ exact[..., :3, :3]
        rows = torch.cat([rotation, self.apply(exact[..., :3, 3])[..., None]], -1)
        return torch.cat([rows, exact[..., 3:, :]], -2).to(c2w.dtype)

    @full_precision
    def inverse(self) -> "Similarity":
        return Similarity(1 / self.scale, self.rotation.T, -(self.rotation.T @ self.translation) / self.scale)

    def compose(self, first: "Similarity") -> "Similarity":
        """The transform that applies ``first``, then this one."""
        return Similarity(self.scale * first.scale, self.rotation @ first.rotation, self.apply(first.translation))

    def is_identity(self) -> bool:
        """Whether the transform is exactly the identity."""
        return torch.equal(self.matrix(), torch.eye(4, dtype=torch.float64, device="cpu"))


def output_frame(up: str) -> Similarity:
    """Transform to the asset frame, whose +Y is the axis ``up`` of the input cameras' frame; else InputError."""
    if up not in UP:
        raise InputError("up", f"expected one of {', '.join(UP)}, got {up}")
    return replace(Similarity.identity(), rotation=torch.tensor(UP[up], dtype=torch.float64, device="cpu"))
