"""In CI a test skips for CUDA or the data of ``../shared``, and for nothing else."""

import os
import subprocess
import sys

import pytest

from tests.support.checkout import ROOT

SKIPPING = """
import pytest

@pytest.mark.parametrize("reason", ["needs CUDA", "needs the data folder ../shared/data", "needs Chromium"])
def test_it(reason):
    pytest.skip(reason)
"""


@pytest.mark.parametrize("ci, ends", [("true", "1 failed, 2 skipped, 1 error"), ("", "4 skipped")])
def test_another_reason_fails_in_ci(tmp_path, ci, ends):
    (tmp_path / "test_it.py").write_text(SKIPPING)
    (tmp_path / "test_module.py").write_text("import pytest\npytest.importorskip('no_such_module')\n")
    (tmp_path / "conftest.py").write_text((ROOT / "tests" / "conftest.py").read_text())
    environment = {**os.environ, "CI": ci, "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "--continue-on-collection-errors"]
    done = subprocess.run([*command, str(tmp_path)], cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert done.stdout.splitlines()[-1].startswith(ends), done.stdout
