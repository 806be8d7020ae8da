"""The documents: every Python block runs, every link and path leads somewhere."""

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import torch

import reli3d
from reli3d.io.hdr import write_environment
from tests.support.checkout import ROOT, copied
from tests.support.layers import LAYERS
from tests.support.scenes import sky

PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")])
NOT_RUN = "<!-- not run:"  # on a line of its own before a block
FILE = re.compile(r"# ([\w/]+\.py)\n")  # first line of a block that is a file of the repository


def blocks(page: Path) -> list[str]:
    """Code of the fenced Python blocks of a page, each moved down to its line in the page."""
    text, found = page.read_text(), []
    for block in re.finditer(r"^```python\n(.*?)^```", text, re.MULTILINE | re.DOTALL):
        above = text[: block.start(1)]
        if NOT_RUN not in above.rstrip().removesuffix("```python").rstrip().rpartition("\n")[2]:
            found.append("\n" * above.count("\n") + block.group(1))
    return found


def name_of(page: Path) -> str:
    return str(page.relative_to(ROOT))


# the tests of an added operation, and its bench case, in the folder of a copy
ADDED = """
import pytest
from bench.solid_angle import CASES
files = ["tests/geometry/test_solid_angle.py", "tests/project/test_structure.py"]
assert pytest.main(["-q", "-p", "no:cacheprovider", *files, "-k", "solid_angle"]) == 0
build, options = CASES["angles"]
build("cpu", n=1000)[0]()
"""

WITH_CODE = [page for page in PAGES if any(not FILE.match(code.lstrip("\n")) for code in blocks(page))]


@pytest.fixture
def folder(tmp_path, monkeypatch) -> Path:
    """Working folder with the files of a reader: an object folder ``photos/shoe`` and a light ``studio.hdr``."""
    shutil.copytree(Path(reli3d.__file__).parent / "assets" / "example", tmp_path / "photos" / "shoe")
    cameras = tmp_path / "photos" / "shoe" / "transforms.json"
    data = json.loads(cameras.read_text())
    cameras.write_text(json.dumps({**data, "frames": data["frames"][:4]}))  # of twelve, for time
    write_environment(tmp_path / "studio.hdr", sky())
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize("page", WITH_CODE, ids=name_of)
def test_code_of_a_page_runs_from_top_to_bottom(page, folder):
    names = {"__name__": "page"}
    with torch.random.fork_rng():
        torch.manual_seed(0)
        for code in blocks(page):
            exec(compile(code, str(page), "exec"), names)


def test_the_kernel_of_the_contributors_page_works_in_the_package(tmp_path):
    """Its files are written into a copy: test, layout and bench case."""
    copied(tmp_path)
    for code in blocks(ROOT / "CONTRIBUTING.md"):
        (tmp_path / FILE.match(code.lstrip("\n")).group(1)).write_text(code)
    paths = {path for path in tmp_path.rglob("*solid_angle.py") if not path.is_symlink()}
    assert len(paths) == 4 == len(blocks(ROOT / "CONTRIBUTING.md"))
    env = {**os.environ, "PYTHONPATH": str(tmp_path)}
    done = subprocess.run([sys.executable, "-c", ADDED], cwd=tmp_path, env=env, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_links_and_paths_of_a_page_lead_somewhere(page):
    text = re.sub(r"^```.*?^```", "", page.read_text(), flags=re.MULTILINE | re.DOTALL)
    for target in re.findall(r"\]\(([^)#\s]+)", text):
        assert target.startswith("https://") or (page.parent / target).exists(), target
    if page.name == "CHANGELOG.md":  # names removed things
        return
    for path in re.findall(r"`((?:reli3d|tests|bench|examples|tools|docs)/[\w/.-]*\w)`", text):
        assert (ROOT / path).exists(), path
    layers = "|".join(set().union(*LAYERS))
    for path in re.findall(rf"`((?:{layers})/\w+\.py)`", text):
        assert (ROOT / "reli3d" / path).exists(), path


def test_citation_and_changelog_have_the_version():
    citation, changelog = ((ROOT / name).read_text() for name in ("CITATION.cff", "CHANGELOG.md"))
    assert f"\nversion: {reli3d.__version__}\n" in citation
    released = [v for v in re.findall(r"^## (\S+)", changelog, re.MULTILINE) if v != "Unreleased"]
    assert released[0] == reli3d.__version__ and len(set(released)) == len(released)
