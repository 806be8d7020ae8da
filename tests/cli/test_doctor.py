"""``reli3d doctor``: reports present and missing parts, and whether the package can work."""

import hashlib
import json
import re

import pytest
import torch
import warp

import reli3d
from reli3d.cli import doctor
from tests.support.checkout import ROOT


def dependencies() -> list[str]:
    text = (ROOT / "pyproject.toml").read_text()
    return re.findall(r'"([A-Za-z0-9-]+)', re.search(r"^dependencies = \[(.*?)\]", text, re.DOTALL | re.MULTILINE)[1])


@pytest.fixture
def assets(tmp_path, monkeypatch):
    """A folder with weights and an example, in place of the shipped ones."""
    (tmp_path / "weights").mkdir()
    (tmp_path / "weights" / "small.safetensors").write_bytes(b"weights")
    (tmp_path / "example").mkdir()
    (tmp_path / "example" / "transforms.json").write_text("{}")
    monkeypatch.setattr(doctor, "ASSETS", tmp_path)
    return tmp_path


def test_report_names_versions_devices_cache_and_weights(assets):
    found, usable = doctor.examine()
    rows = dict(found)
    assert rows["reli3d"].startswith(reli3d.__version__)
    # the CUDA wheel of the package index does not name its build in its metadata
    assert rows["torch"] in (torch.__version__, torch.__version__.split("+")[0])
    assert set(dependencies()) <= set(rows)
    assert rows["warp-lang"] == warp.__version__
    assert str(warp.config.kernel_cache_dir) in rows["kernel cache"] and "writable" in rows["kernel cache"]
    assert hashlib.sha256(b"weights").hexdigest() in rows["weights, small"]
    assert rows["kernels, cpu"].startswith("run") and rows["verdict"] == "usable"
    assert usable and not any(doctor.PROBLEM in value for value in rows.values())


def test_missing_weights_are_a_problem_in_the_table_and_in_json(assets, capsys):
    for usable, verdict in ((True, "usable"), (False, "not usable: 1 problem")):
        assert doctor.main([]) == doctor.main(["--json"]) == (0 if usable else 1)
        *table, line = capsys.readouterr().out.splitlines()
        assert table[-1].split(maxsplit=1) == ["verdict", verdict] and str(table).count(doctor.PROBLEM) == (not usable)
        found = json.loads(line)
        assert found["usable"] is usable and found["verdict"] == verdict and len(found) == len(table) + 1
        assert found["weights, small"].startswith(doctor.PROBLEM) is not usable
        (assets / "weights" / "small.safetensors").unlink(missing_ok=True)


def test_a_part_that_fails_is_reported_and_the_rest_continues(assets, monkeypatch):
    def broken():
        raise RuntimeError("the driver is gone")

    monkeypatch.setattr(doctor, "_devices", broken)
    rows, usable = doctor.examine()
    assert "the driver is gone" in str(rows) and "weights, small" in dict(rows) and not usable


def test_missing_package_is_a_problem(assets, monkeypatch):
    monkeypatch.setattr(doctor.metadata, "requires", lambda _: ["no-such-package-of-reli3d>=1", "x; extra == 'y'"])
    rows, usable = doctor.examine()
    (found,) = [v for _, v in rows if "pip" in v]
    assert found == f"{doctor.PROBLEM}not installed: pip install no-such-package-of-reli3d" and not usable


def test_a_checkout_that_is_not_installed_is_usable(monkeypatch):
    def absent(name):
        raise doctor.metadata.PackageNotFoundError(name)

    monkeypatch.setattr(doctor.metadata, "requires", absent)
    rows, usable = doctor.examine()
    assert usable and dict(rows)["dependencies"].startswith("unknown") and "python" in dict(rows)


def test_the_constraints_name_every_dependency_and_reference():
    pins = re.findall(r"^([\w-]+)==", (ROOT / "constraints.txt").read_text(), re.MULTILINE)
    extras = re.search(r"^test = \[(.*?)\]", (ROOT / "pyproject.toml").read_text(), re.MULTILINE).group(1)
    expected = (*dependencies(), *re.findall(r'"([\w-]+)', extras))
    assert {name.lower() for name in expected} <= {name.lower() for name in pins}
