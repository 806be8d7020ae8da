"""``reli3d capture``: exit codes, lines on stderr and files left on the disk."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from PIL import Image

from reli3d.capture import capture as function
from reli3d.capture.report import CaptureReport
from reli3d.cli import infer
from reli3d.cli.capture import main
from tests.support.processes import heed_signals


def write_noise(folder, count: int):
    """Images of ``count`` different patterns: none matches another."""
    folder.mkdir()
    for k in range(count):
        coarse = np.random.default_rng(k).integers(0, 255, (60, 80, 3), dtype=np.uint8)
        Image.fromarray(coarse).resize((320, 240), Image.Resampling.NEAREST).save(folder / f"{k}.png")
    return folder


def test_photographs_without_overlap_are_refused_in_one_line(tmp_path, capsys):
    assert main([str(write_noise(tmp_path / "photos", 8)), str(tmp_path / "out")]) == 2
    err = capsys.readouterr().err.strip()
    assert "\n" not in err and "expected images that overlap" in err and "walk around the object" in err
    assert {p.name for p in tmp_path.iterdir()} == {"photos"}


def test_a_segmentation_network_that_is_not_installed_is_refused(tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "rembg", None)
    photos = str(write_noise(tmp_path / "photos", 8))
    assert main([photos, str(tmp_path / "out"), "--mask-method", "rembg"]) == 2
    err = capsys.readouterr().err
    assert err.startswith("reli3d capture: mask-method: ") and "pip install 'reli3d[masks]'" in err


def test_a_missing_extra_is_named_with_the_command_that_installs_it(tmp_path):
    code = "import sys; sys.modules['cv2'] = None; from reli3d.cli.capture import main; sys.exit(main(sys.argv[1:]))"
    command = [sys.executable, "-c", code, str(tmp_path), str(tmp_path / "out")]
    result = subprocess.run(command, capture_output=True, text=True)
    err = result.stderr.strip().splitlines()[-1]
    assert result.returncode == 2 and err == "reli3d capture: cv2: is not installed: pip install 'reli3d[capture]'"


@pytest.mark.parametrize("code, iou, expected", [(0, 0.95, 0), (1, 0.95, 1), (2, 0.95, 2), (0, 0.85, 3)])
def test_the_exit_code_is_that_of_the_reconstruction_or_of_its_silhouettes(
    tmp_path, monkeypatch, capsys, code, iou, expected
):
    report = CaptureReport(20, registered=20)

    def reconstruct(argv):
        target = tmp_path / "out" / "asset" / "out"
        assert argv == [str(tmp_path / "out"), "--output", str(target.parent)]
        target.mkdir(parents=True)
        (target / "run_info.json").write_text(json.dumps({"mask_iou": iou}))
        other = target.parent / "another"  # of a capture before the folder was renamed
        other.mkdir()
        (other / "run_info.json").write_text(json.dumps({"mask_iou": 1.0 - iou}))
        return code

    monkeypatch.setattr(function, "capture", lambda *_: report)
    monkeypatch.setattr(infer, "main", reconstruct)
    assert main([str(tmp_path), str(tmp_path / "out"), "--infer"]) == expected
    assert ("mask IoU of the asset 0.850" in capsys.readouterr().err) == (expected == 3)


def test_a_termination_while_features_are_extracted_removes_all_files(tmp_path):
    """COLMAP's library installs a handler of SIGTERM that ends the process with a stack trace."""
    photos = write_noise(tmp_path / "photos", 40)
    (tmp_path / "temporary").mkdir()
    command = [sys.executable, "-m", "reli3d.cli.capture", str(photos), str(tmp_path / "out")]
    environment = os.environ | {"TMPDIR": str(tmp_path / "temporary")}
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True, env=environment, preexec_fn=heed_signals)
    with process:
        deadline = time.monotonic() + 120
        while not list((tmp_path / "temporary").glob("*/database.db")) and time.monotonic() < deadline:
            time.sleep(0.05)
        process.send_signal(signal.SIGTERM)
        err = process.stderr.read().strip()
    assert process.returncode == 128 + signal.SIGTERM and err.splitlines()[-1] == "reli3d capture: ended by SIGTERM"
    assert "stack trace" not in err
    assert not list((tmp_path / "temporary").iterdir()) and not (tmp_path / "out").exists()
