"""The layout of the package: who imports whom, and that importing it is cheap and silent."""

import ast
import dataclasses
import functools
import graphlib
import importlib
import re
import subprocess
import sys
from pathlib import Path

import pytest

import reli3d
from reli3d.nn import presets
from tests.support.checkout import ROOT
from tests.support.layers import LAYERS

PACKAGE = ROOT / "reli3d"
SOURCES = sorted(PACKAGE.rglob("*.py"))
POSITION = {part: position for position, layer in enumerate(LAYERS) for part in layer}
STARTERS = {"torch", "warp"}  # what ``import reli3d`` alone must not load


def part_of(module: str) -> str:
    """``reli3d.geometry.mesh`` -> ``geometry``; ``reli3d`` itself -> ``""``."""
    return (module.split(".") + [""])[1]


def name_of(path: Path) -> str:
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


MODULES = {name_of(path) for part in ("reli3d", "tests", "bench") for path in (ROOT / part).rglob("*.py")}


@functools.cache
def imports(source: str, module: str, is_package: bool) -> list[str]:
    """Every module that ``source`` imports, at the top or inside functions, with relative names made absolute.

    ``from a import b`` gives ``a.b`` where that is a module of the checkout, the module that defines ``b`` where ``a``
    is ``reli3d``, else ``a``.
    """
    found = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            found += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                above = module.split(".")[: len(module.split(".")) - node.level + is_package]
                base = ".".join([*above, base] if base else above)
            for name in (f"{base}.{alias.name}" for alias in node.names):
                public = base == "reli3d" and name not in MODULES and getattr(reli3d, name.split(".")[1], None)
                found.append(name if name in MODULES else getattr(public, "__module__", None) or base)
    return found


def violations(source: str, module: str, is_package: bool = False) -> list[str]:
    """What in ``source`` breaks the direction of imports, as text."""
    part, bad = part_of(module), []
    for target in imports(source, module, is_package):
        top = target.split(".")[0]
        if part == "kernels" and top == "torch":
            bad.append(f"{module} imports torch; kernels are Warp only")
        if part in ("io", "views", "fit", "pipeline", "output", "train", "eval", "") and top == "warp":
            bad.append(f"{module} imports warp; what launches kernels is a public operation of its own")
        if top in ("tests", "bench"):
            bad.append(f"{module} imports {target}, which is not shipped")
        other = part_of(target) if top == "reli3d" and part else ""
        if other not in ("", part) and POSITION[other] >= POSITION[part]:
            bad.append(f"{module} imports {target}, which does not lie below it")
    return bad


@pytest.mark.parametrize("path", SOURCES, ids=lambda p: name_of(p))
def test_imports_point_down(path):
    module = name_of(path)
    part = part_of(module)
    assert not part or part in POSITION, f"{part}: give the new part its place in LAYERS"
    assert violations(path.read_text(), module, path.name == "__init__.py") == []


PRESETS = (presets.OFFICIAL, presets.TINY, presets.SMALL)


def leaves(fields: dict) -> list[tuple]:
    """Names and values of all fields, those of nested ones included."""
    return [pair for k, v in fields.items() for pair in (leaves(v) if isinstance(v, dict) else [(k, v)])]


def constants_of_presets(source: str) -> list[str]:
    """Constants in ``source`` that repeat a preset: the name of one of its fields, or the half side of its cubes."""
    fields = [pair for preset in PRESETS for pair in leaves(dataclasses.asdict(preset))]
    names, radii = {name.upper() for name, _ in fields}, {value for name, value in fields if name == "radius"}
    tree = ast.parse(source)
    assigned = [part for node in tree.body if isinstance(node, ast.Assign | ast.AnnAssign) for part in ast.walk(node)]
    bad = [n.id for n in assigned if isinstance(n, ast.Name) and isinstance(n.ctx, ast.Store) and n.id in names]
    numbers = [node.value for node in ast.walk(tree) if isinstance(node, ast.Constant)]
    return bad + [str(v) for v in numbers if isinstance(v, float) and v in radii]


def test_kernels_geometry_and_render_contain_no_constant_of_a_preset():
    below = [path for path in SOURCES if part_of(name_of(path)) in ("kernels", "geometry", "render")]
    found = {name_of(path): constants_of_presets(path.read_text()) for path in below}
    assert len(found) > 50 and {name: bad for name, bad in found.items() if bad} == {}


def of_other_tests(source: str, module: str) -> list[str]:
    """The imports of a file of ``tests`` from test modules, or one of ``bench`` from ``tests``."""
    found = [target.split(".") for target in imports(source, module, False)]
    if module.startswith("bench."):
        return [".".join(parts) for parts in found if parts[0] == "tests"]
    return [".".join(parts) for parts in found if any(p == "conftest" or p.startswith("test_") for p in parts)]


@pytest.mark.parametrize("folder", ["tests", "bench"])
def test_no_test_imports_another_and_bench_imports_no_test(folder):
    files = sorted((ROOT / folder).rglob("*.py"))
    found = {name_of(path): of_other_tests(path.read_text(), name_of(path)) for path in files}
    assert len(found) > 20 and {name: bad for name, bad in found.items() if bad} == {}


def circle(sources: dict[str, str]) -> list[str]:
    """Modules that import each other in a circle, of ``sources`` by module name; empty where there is none."""
    graph = {name: set(imports(text, name, False)) & set(sources) for name, text in sources.items()}
    try:
        list(graphlib.TopologicalSorter(graph).static_order())
    except graphlib.CycleError as error:
        return error.args[1]
    return []


def test_modules_import_each_other_in_no_circle():
    sources = {name_of(p): p.read_text() for p in SOURCES if p.name != "__init__.py"}
    assert circle(sources) == []
    down = next(n for n in imports(sources["reli3d.geometry.rays"], "reli3d.geometry.rays", False) if n in sources)
    sources[down] += "\nfrom reli3d.geometry import rays\n"
    assert {down, "reli3d.geometry.rays"} <= set(circle(sources))  # other modules may lie between the two


def writes_to_stdout(source: str) -> list[int]:
    """Lines of ``source`` that print without ``file=`` or name stdout."""
    found = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "print":
            found += [node.lineno] * all(k.arg != "file" for k in node.keywords)
        if isinstance(node, ast.Attribute) and node.attr in ("stdout", "__stdout__"):
            found.append(node.lineno)
    return found


def test_nothing_below_the_commands_writes_to_stdout():
    below = [path for path in SOURCES if part_of(name_of(path)) != "cli"]
    found = {name_of(path): writes_to_stdout(path.read_text()) for path in below}
    assert len(found) > 50 and {name: lines for name, lines in found.items() if lines} == {}
    assert writes_to_stdout("import sys\nprint(1)\nsys.stdout.write('')\nprint(1, file=sys.stderr)") == [2, 3]


def run(code: str) -> subprocess.CompletedProcess:
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, timeout=120)


def test_import_is_silent_and_starts_nothing():
    done = run(
        "import sys, reli3d\n"
        "assert reli3d.geometry.__doc__ and reli3d.render.__doc__ and reli3d.io.__doc__ and reli3d.fit.__doc__\n"
        "assert reli3d.errors.InputError\n"
        f"print(sorted({STARTERS} & set(sys.modules)), reli3d.__version__)"
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.split() == ["[]", reli3d.__version__]


@pytest.mark.parametrize("package", ["fit", "geometry", "io", "render"])
def test_the_docstring_of_a_public_package_names_its_modules(package):
    modules = {path.stem for path in (ROOT / "reli3d" / package).glob("[a-z]*.py")}
    assert modules <= set(re.findall(r"\w+", getattr(reli3d, package).__doc__))


def test_public_names_load_without_network_device_or_output():
    """All but the pipeline's, which holds the networks."""
    names = [name for name in reli3d.__all__ if getattr(getattr(reli3d, name), "__module__", "") != "reli3d.pipeline"]
    assert len(names) > 10
    done = run(
        "import sys, reli3d\n"
        f"for name in {names}: getattr(reli3d, name)\n"
        "import torch\n"
        "assert not torch.cuda.is_initialized()\n"
        "hubs = {'huggingface_hub', 'requests', 'urllib3'}\n"
        "assert not any(m.startswith('reli3d.nn') or m.split('.')[0] in hubs for m in sys.modules)\n"
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
    with pytest.raises(AttributeError, match="no_such_name"):
        reli3d.no_such_name  # noqa: B018


def test_every_command_of_the_package_exists():
    commands = re.findall(r'^reli3d[\w-]* = "([\w.]+):(\w+)"', (ROOT / "pyproject.toml").read_text(), re.MULTILINE)
    assert len(commands) >= 3
    for module, function in commands:
        assert callable(getattr(importlib.import_module(module), function)), module
