"""``python -m bench.cuda`` without CUDA: its plan, its limits, and that a piece that fails ends only itself."""

import json

import pytest
import torch

from bench import cuda
from bench.cuda import Piece, limits, main, pieces, report, run, run_piece


@pytest.mark.skipif(torch.cuda.is_available(), reason="needs a machine without CUDA")
def test_without_cuda_it_reports_it_in_one_line(capsys, tmp_path):
    assert main(["--output", str(tmp_path / "none")]) == 2
    found = capsys.readouterr().err
    assert found.count("\n") == 1 and "expected a CUDA device" in found and not (tmp_path / "none").exists()


def test_a_dry_run_lists_all_pieces_and_limits_that_add_up_to_the_budget(capsys):
    assert main(["--dry-run", "--minutes", "6"]) == 0
    lines = capsys.readouterr().out.splitlines()
    names = [piece.name for piece in pieces("cuda")]
    assert [line.split(" s  ")[1].split(":")[0] for line in lines[:-1]] == names
    assert sum(int(line.split(" s ")[0]) for line in lines[:-1]) == pytest.approx(360, abs=4)  # rounded to seconds
    assert names.index("compile") < names.index("operations, CPU against CUDA") < names.index("bench cases")


def test_missing_dependencies_are_named_before_anything_runs(capsys, monkeypatch, tmp_path):
    monkeypatch.setattr(cuda, "NEEDED", ("torch", "no_such_package_of_reli3d"))
    assert main(["--output", str(tmp_path / "none")]) == 2
    found = capsys.readouterr()
    assert "missing packages: no_such_package_of_reli3d" in found.out and not (tmp_path / "none").exists()


@pytest.mark.parametrize(
    "code, seconds, end",
    [
        ("print('fine')", 60.0, "ok"),
        ("raise SystemExit(3)", 60.0, "failed (3)"),
        ("print('half', flush=True); import time; time.sleep(60)", 3.0, "out of time (3 s)"),
    ],
)
def test_a_piece_that_fails_or_hangs_is_reported(code, seconds, end, tmp_path):
    row = run_piece(Piece("piece", ("-c", code), 1), tmp_path, seconds)
    assert row["end"] == end
    text = report([row], "cpu")
    assert f"| piece | {end} |" in text and ("half" in text) == ("half" in code)


def test_a_second_call_repeats_only_what_did_not_end_well(tmp_path):
    """Into a new folder; the limits of the remaining pieces take the whole time."""
    out, trace = tmp_path / "new" / "folder", tmp_path / "trace"
    write = f"open({str(trace)!r}, 'a').write"
    plan = [Piece("a", ("-c", f"{write}('a')"), 1), Piece("b", ("-c", f"{write}('b'); import sys; sys.exit(1)"), 1)]
    assert [row["end"] for row in run(plan, "cpu", out, 100.0)] == ["ok", "failed (1)"]
    assert [row["end"] for row in run(plan, "cpu", out, 100.0)] == ["ok", "failed (1)"]
    assert trace.read_text() == "abb"
    stored = json.loads((out / "cuda.json").read_text())
    assert [row["name"] for row in stored["pieces"]] == ["a", "b"]
    assert "| b | failed (1) |" in (out / "cuda.md").read_text()
    assert limits(plan[1:], 100.0) == [100.0]


def test_no_piece_begins_without_time(tmp_path):
    rows = run([Piece("piece", ("-c", "import time; time.sleep(60)"), 1)], "cpu", tmp_path, 1.0)
    assert rows[0]["end"] == "left out: no time left"


@pytest.mark.slow
def test_the_pieces_end_well_on_a_cpu(tmp_path):
    names = ["system", "training stages", "official network, bfloat16"]
    assert main(["--device", "cpu", "--output", str(tmp_path / "out"), "--only", *names]) == 0
    text = (tmp_path / "out" / "cuda.md").read_text()
    assert text.count("| ok |") == 3 and '"tiny, volume"' in text
