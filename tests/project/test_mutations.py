"""The tests notice a broken formula: one line of a copy of the package is changed at a time, by 3 % or in its sense."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.support.checkout import copied

pytestmark = pytest.mark.slow  # every kernel that is changed compiles again


# name: file of the package, what stands there, what it becomes, the tests that should see it
BROKEN = {
    "bilinear weight": (
        "kernels/triplane.py",
        "w11 = u * v\n        base",
        "w11 = 1.03 * u * v\n        base",
        "geometry/test_triplane.py -k float64",
    ),
    "green of a normal map": (
        "kernels/bump.py",
        "wp.cross(n, t) * tangent[i][3]",
        "wp.cross(n, t)",
        "geometry/test_bake.py -k formula",
    ),
    "slope of a plane": (
        "kernels/triplane.py",
        "wp.dot(down, one) * 0.5 *",
        "wp.dot(down, one) * 0.515 *",
        "geometry/test_triplane.py -k float64",
    ),
    "crossing of an edge": (
        "kernels/flexicubes.py",
        "a / (a + b), b / (a + b), a + b",
        "wp.float64(1.03) * a / (a + b), b / (a + b), a + b",
        "geometry/test_surface_gradients.py -k plain_float64",
    ),
    "gradient of alpha": (
        "kernels/flexicubes_adjoint.py",
        "- float(g_size / alpha_b)",
        "+ float(g_size / alpha_b)",
        "geometry/test_surface_gradients.py -k plain_float64",
    ),
    "manifold fix": (
        "kernels/flexicubes.py",
        "neighbour[int(codes[cell + step])] == face - 1:",
        "neighbour[int(codes[cell + step])] == face + 7:",
        "geometry/test_surface.py -k noise",
    ),
    "orientation": (
        "kernels/flexicubes.py",
        "outward = grid.level[v] < 0.0",
        "outward = grid.level[v] >= 0.0",
        "geometry/test_surface.py -k sign_pattern",
    ),
    "tangent of a corner": (
        "kernels/tangents.py",
        "unit(flat(along_u, n)) * angle",
        "unit(flat(along_u, n)) * wp.sqrt(angle)",
        "geometry/test_bake.py -k tangents",
    ),
    "border of a chart": ("geometry/bake.py", "REACH = 1.5", "REACH = 1.3", "geometry/test_bake.py -k bilinear"),
    "guard band": (
        "geometry/uv.py",
        "guard = guard_band(texture_size)\n",
        "guard = guard_band(texture_size) // 2\n",
        "geometry/test_uv.py -k guard_band",
    ),
    "area of a normal": (
        "geometry/mesh.py",
        "index_add(0, corner, per_face)",
        "index_add(0, corner, torch.nn.functional.normalize(per_face, dim=-1))",
        "geometry/test_mesh.py",
    ),
    "pass band": (
        "geometry/smooth.py",
        "1.0 / (pass_band - 1.0 / step)",
        "1.03 / (pass_band - 1.0 / step)",
        "geometry/test_smooth.py",
    ),
    "pixel at a depth": (
        "kernels/hull.py",
        "value * depth * 2.0 /",
        "value * depth * 2.06 /",
        "geometry/test_geometry_fuzz.py -k hull",
    ),
    "masking": (
        "kernels/microfacet.py",
        "return 0.5 / (wi[2] * facet.root_o",
        "return 0.515 / (wi[2] * facet.root_o",
        "render/test_material.py -k float64",
    ),
    "antithetic partner": (
        "kernels/sampling.py",
        "(1.0 - TO_UNIT) - u[1]",
        "u[1]",
        "render/test_estimator.py -k cancel",
    ),
}


def run(folder: Path, tests: str) -> subprocess.CompletedProcess:
    file, *options = tests.split(maxsplit=2)
    command = [sys.executable, "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", f"tests/{file}", *options]
    return subprocess.run(
        command, cwd=folder, env={**os.environ, "PYTHONPATH": str(folder)}, capture_output=True, text=True, timeout=600
    )


def test_an_unbroken_copy_passes(tmp_path):
    folder = copied(tmp_path)
    for tests in sorted({entry[-1] for entry in BROKEN.values()}):
        done = run(folder, tests)
        assert done.returncode == 0, done.stdout


@pytest.mark.parametrize("name", BROKEN)
def test_a_broken_formula_is_seen(tmp_path, name):
    file, before, after, tests = BROKEN[name]
    folder = copied(tmp_path)
    source = folder / "reli3d" / file
    text = source.read_text()
    assert text.count(before) == 1, "the formula has changed: break it where it is now"
    source.write_text(text.replace(before, after))
    done = run(folder, tests)
    assert done.returncode == 1 and " failed" in done.stdout, done.stdout  # a test, not the collection
