"""The bundled example, elsewhere, and options that make it in little time."""

import json
from pathlib import Path

import torch

from reli3d.cli.infer import EXAMPLE

QUICK = ["--texture-size", "256", "--resolution", "40", "--device", "cpu"]


def moved_example(folder: Path, matrix: torch.Tensor) -> Path:
    """The bundled example with the world carried by ``matrix`` (a similarity); images are links."""
    folder.mkdir()
    record = json.loads((EXAMPLE / "transforms.json").read_text())
    scale = torch.linalg.det(matrix[:3, :3]).abs() ** (1 / 3)
    for frame in record["frames"]:
        pose = matrix @ torch.tensor(frame["transform_matrix"], dtype=torch.float64)
        pose[:3, :3] /= scale
        frame["transform_matrix"] = pose.tolist()
    (folder / "transforms.json").write_text(json.dumps(record))
    (folder / "rgba").mkdir()
    for image in (EXAMPLE / "rgba").iterdir():
        (folder / "rgba" / image.name).write_bytes(image.read_bytes())
    return folder
