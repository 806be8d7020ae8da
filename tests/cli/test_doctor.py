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


def test_command_reports_usable_on_stdout(assets, capsys):
    assert doctor.main([]) == 0
    assert capsys.readouterr().out.splitlines()[-1].endswith(" usable")


def test_json_has_the_rows_by_name_and_the_verdict(assets, capsys):
    assert doctor.main(["--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["usable"] is True and found["reli3d"].startswith(reli3d.__version__) and found["verdict"] == "usable"
    (assets / "weights" / "small.safetensors").unlink()
    assert doctor.main(["--json"]) == 1
    found = json.loads(capsys.readouterr().out)
    assert found["usable"] is False and found["weights, small"].startswith(doctor.PROBLEM)


def test_missing_weights_are_a_problem(assets, capsys):
    (assets / "weights" / "small.safetensors").unlink()
    assert doctor.main([]) == 1
    out = capsys.readouterr().out
    assert out.count(doctor.PROBLEM) == 1 and out.splitlines()[-1].endswith("not usable: 1 problem")


def test_a_part_that_fails_is_reported_and_the_rest_continues(assets, monkeypatch):
    def broken():
        raise RuntimeError("the driver is gone")

    monkeypatch.setattr(doctor, "_devices", broken)
    rows, usable = doctor.examine()
    assert "the driver is gone" in str(rows) and "weights, small" in dict(rows) and not usable


def test_missing_package_is_a_problem(assets, monkeypatch):
    monkeypatch.setattr(doctor.metadata, "requires", lambda _: ["no-such-package-of-reli3d>=1", "x; extra == 'y'"])
    rows, usable = doctor.examine()
    assert [v for _, v in rows if "pip" in v] == [
        f"{doctor.PROBLEM}not installed: pip install no-such-package-of-reli3d"
    ]
    assert not usable


def test_a_checkout_that_is_not_installed_is_usable(monkeypatch):
    def absent(name):
        raise doctor.metadata.PackageNotFoundError(name)

    monkeypatch.setattr(doctor.metadata, "requires", absent)
    rows, usable = doctor.examine()
    assert usable and dict(rows)["dependencies"].startswith("unknown") and "python" in dict(rows)


@pytest.mark.parametrize("arguments", [["surgeon"], ["--now"]])
def test_wrong_call_ends_with_two(arguments):
    assert doctor.main(arguments) == 2


def test_the_constraints_name_every_dependency_and_reference():
    folder = ROOT
    pins = re.findall(r"^([\w-]+)==", (folder / "constraints.txt").read_text(), re.MULTILINE)
    text = (folder / "pyproject.toml").read_text()
    extras = re.search(r"^test = \[(.*?)\]", text, re.MULTILINE).group(1)
    expected = (*dependencies(), *re.findall(r'"([\w-]+)', extras))
    assert {name.lower() for name in expected} <= {name.lower() for name in pins}
