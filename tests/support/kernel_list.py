"""The kernel modules that ``reli3d-infer`` launches, found by runs of it.

``python -m tests.support.kernel_list`` writes them to ``reli3d/assets/kernels.json``, which the command reads to
compile them side by side at its first run.  Tests compare the file with new runs.
"""

import json
import subprocess
import sys
import tempfile
from pathlib import Path

import torch

from reli3d.cli.infer import KERNELS
from reli3d.nn.model import Reconstructor
from reli3d.nn.weights import save
from tests.support.example import QUICK
from tests.support.networks import TINY

RUN = """
import sys
from reli3d.cli import infer
infer.needed_kernels = lambda *_, **__: []
infer.ready_kernels = lambda *_: None
assert infer.main(sys.argv[1:]) == 0
import warp
loaded = [n for n in sorted(sys.modules) if n.startswith("reli3d.kernels.") and warp.get_module(n).execs]
heavy = [n for n in ("torch._dynamo", "trimesh", "matplotlib") if n in sys.modules]
sys.stdout.write(" ".join(n.split(".")[-1] for n in loaded) + ";" + " ".join(heavy))
"""
CASES = {
    "LocalReconstructor": [],
    "Reconstructor": ["--weights", "tiny.safetensors"],
    "refine": ["--refine-steps", "6"],
}


def launched(case: str) -> tuple[list[str], list[str]]:
    """Kernel modules that a run launches on a CPU, and heavy modules of Python that it imports."""
    with tempfile.TemporaryDirectory() as folder:
        if case == "Reconstructor":  # a field that crosses its threshold all over the cube
            torch.manual_seed(0)
            model = Reconstructor(TINY).eval()
            model.heads["density"][-1].bias.data.fill_(model.surface_density)
            save(Path(folder) / "tiny.safetensors", model, licence="of the tests", dtype=torch.float32)
        command = [sys.executable, "-c", RUN, "--output", folder, *QUICK, *CASES[case]]
        done = subprocess.run(command, capture_output=True, text=True, cwd=folder)
    assert done.returncode == 0, done.stderr
    return tuple(part.split() for part in done.stdout.splitlines()[-1].split(";"))


if __name__ == "__main__":
    KERNELS.write_text(json.dumps({case: launched(case)[0] for case in CASES}, indent=1) + "\n")
