"""The main job: views of the bundled example to a textured mesh and an environment, warm and stage by stage."""

import subprocess
import sys
import tempfile
import time
from importlib import resources
from pathlib import Path

from reli3d.io.glb import write_glb
from reli3d.nn.weights import load_model
from reli3d.pipeline import ReconstructOptions, Stopwatch, reconstruct
from reli3d.views.folder import load_views


def example() -> Path:
    return Path(str(resources.files("reli3d") / "assets" / "example"))


def views_to_glb(device, texture_size, resolution):
    """Views and ``small`` weights in memory to ``mesh.glb`` on disk; the parts of the time are the pipeline's own."""
    views = load_views(example()).select(4)
    model = load_model("small", str(device))
    options = ReconstructOptions(texture_size=texture_size, resolution=resolution)
    folder = tempfile.TemporaryDirectory()

    def step():
        watch = Stopwatch(device)
        asset = reconstruct(views, weights=model, options=options, watch=watch)
        start = time.perf_counter()
        write_glb(Path(folder.name) / "mesh.glb", asset)
        return {**watch.seconds, "write_glb": time.perf_counter() - start}

    return step, {"objects": 1}


def process(device, arguments):
    """``reli3d-infer`` from the start of the process to its end, with the kernels compiled before."""
    code = "import sys; from reli3d.cli.infer import main; sys.exit(main())"

    def step():
        with tempfile.TemporaryDirectory() as folder:
            command = [sys.executable, "-c", code, str(example()), "--output", folder, "--device", device.type]
            subprocess.run([*command, *arguments], check=True, capture_output=True)

    return step, {"objects": 1}


CASES = {
    "views_to_glb": (views_to_glb, dict(texture_size=512, resolution=None)),  # the preset's own resolution
    "process": (process, dict(arguments=["--texture-size", "512", "--views", "4"])),
}
