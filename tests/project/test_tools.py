"""The maintainers' tools run on what they are given, and say so where it is absent."""

import importlib.util

import pytest

from tests.support import mitsuba_scene
from tests.support.checkout import ROOT

TOOLS = ROOT / "tools"


def tool(name):
    spec = importlib.util.spec_from_file_location(name, TOOLS / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_recovery_without_its_data_is_skipped_with_a_line(tmp_path, capsys):
    assert tool("recover_material").main([str(tmp_path), "--data", str(tmp_path / "none")]) == 0
    assert "skipped: needs" in capsys.readouterr().err


@pytest.mark.slow
def test_recovery_from_mitsubas_images_relights_better_than_its_start(tmp_path, capsys, shared_data):
    mitsuba_scene.load()
    options = ["--data", str(shared_data), "--steps", "40", "--size", "64", "--truth-samples", "32"]
    assert tool("recover_material").main([str(tmp_path), *options]) == 0
    line = next(v for v in capsys.readouterr().out.splitlines() if v.startswith("relighting PSNR"))
    truth, recovered, before = (float(part.split()[-2]) for part in line.split(": ")[1].split(", "))
    assert before + 2.0 < recovered < truth  # a full fit gains 12 dB of the 21 that true maps are better
    assert (tmp_path / "recovered.png").stat().st_size > 1000
