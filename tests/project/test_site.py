"""The site builds without a warning, and the notebook runs from top to bottom."""

import subprocess
import sys

import pytest

from tests.support.checkout import ROOT


def test_the_site_builds_strictly(tmp_path):
    pytest.importorskip("material", reason="needs mkdocs-material (extra docs)")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path / "site")]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    start = (tmp_path / "site/index.html").read_text()
    assert 'href="inputs/"' in start and 'href="changelog/"' in start and "example.jpg" in start
    assert (tmp_path / "site/measurements/quality/index.html").is_file()


def test_the_notebook_runs(tmp_path):
    nbclient = pytest.importorskip("nbclient", reason="needs nbclient and ipykernel (extra docs)")
    nbformat = pytest.importorskip("nbformat")
    book = nbformat.read(ROOT / "examples/start.ipynb", as_version=4)
    assert not any(cell.get("outputs") for cell in book.cells)  # stored without results
    nbclient.NotebookClient(book, timeout=600, resources={"metadata": {"path": str(tmp_path)}}).execute()
    assert (tmp_path / "object.glb").stat().st_size > 10_000
    shown = book.cells[-1].outputs[0]["data"]
    assert "image/png" in shown
