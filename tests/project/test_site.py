"""The site builds without a warning, and the notebook runs from top to bottom."""

import re
import subprocess
import sys

import pytest

import reli3d
from tests.support.checkout import ROOT


def test_the_site_builds_without_a_warning_and_documents_every_public_name(tmp_path):
    pytest.importorskip("zensical", reason="needs zensical and mkdocstrings (extra docs)")
    command = [sys.executable, ".ci/site.py", str(tmp_path / "site")]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    start, reference = ((tmp_path / "site" / name).read_text() for name in ("index.html", "reference/index.html"))
    assert 'href="./changelog/"' in start and 'href="./reference/"' in start
    assert "<blockquote>" not in reference  # of ">>>" that is not a code block
    documented = set(re.findall(r'id="reli3d\.[\w.]*\.(\w+)"', reference))
    assert set(reli3d.__all__) - {"__version__"} <= documented


def test_the_notebook_runs(tmp_path):
    nbclient = pytest.importorskip("nbclient", reason="needs nbclient and ipykernel (extra docs)")
    nbformat = pytest.importorskip("nbformat")
    book = nbformat.read(ROOT / "examples/start.ipynb", as_version=4)
    assert not any(cell.get("outputs") for cell in book.cells)  # stored without results
    nbclient.NotebookClient(book, timeout=600, resources={"metadata": {"path": str(tmp_path)}}).execute()
    assert (tmp_path / "object.glb").stat().st_size > 10_000
    shown = book.cells[-1].outputs[0]["data"]
    assert "image/png" in shown
