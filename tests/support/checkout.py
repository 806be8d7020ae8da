"""The checkout: its folder, the folder of real data next to it, and a copy whose files may be changed."""

import shutil
from pathlib import Path

ROOT = Path(__file__).parents[2]
SHARED = ROOT.parent / "shared"


def copied(folder: Path) -> Path:
    """The package, its tests and benches in ``folder``; the large files are links."""
    for part in ("reli3d", "tests", "bench"):
        shutil.copytree(ROOT / part, folder / part, ignore=shutil.ignore_patterns("__pycache__", "assets", "results"))
    (folder / "reli3d" / "assets").symlink_to(ROOT / "reli3d" / "assets")
    shutil.copy(ROOT / "pyproject.toml", folder)
    return folder
