"""Prints constraints with the lowest version of every dependency that pyproject.toml allows."""

import re
from pathlib import Path

text = (Path(__file__).parents[1] / "pyproject.toml").read_text().split("[project.optional-dependencies]")[0]
found = re.findall(r'^    "([\w.-]+)>=([\w.]+)"', text, re.MULTILINE)
print("\n".join(f"{name}=={version}" for name, version in found))
