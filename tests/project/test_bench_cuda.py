"""``python -m bench.cuda`` without CUDA: its dry run ends well, and a piece that does not ends only itself."""

from pathlib import Path

import pytest

from bench import cuda
from bench.cuda import Piece, main, pieces, report, run_piece


@pytest.mark.skipif(cuda.torch.cuda.is_available(), reason="needs a machine without CUDA")
def test_without_cuda_it_says_so_in_one_line(capsys):
    assert main([]) == 2
    told = capsys.readouterr().err
    assert told.count("\n") == 1 and "expected a CUDA device" in told


def test_all_pieces_fit_into_eight_minutes():
    """However slow they are: the limit cuts them off."""
    assert cuda.LIMIT < 480
    assert {p.name for p in pieces("cuda", False)} >= {p.name for p in pieces("cpu", True)}


@pytest.mark.parametrize(
    "code, seconds, end",
    [
        ("print('fine')", 60.0, "ok"),
        ("raise SystemExit(3)", 60.0, "failed (3)"),
        ("print('half', flush=True); import time; time.sleep(60)", 8.0, "out of time (8 s)"),
    ],
)
def test_a_piece_that_fails_or_hangs_is_told(code, seconds, end, tmp_path):
    row = run_piece(Piece("piece", ("-c", code), seconds), tmp_path, 100.0)
    assert row["end"] == end
    text = report([row], "cpu", True)
    assert f"| piece | {end} |" in text and ("half" in text) == ("half" in code)


def test_no_piece_begins_without_time(tmp_path):
    assert run_piece(Piece("piece", ("-c", "1/0"), 60.0), tmp_path, 1.0)["end"] == "left out: no time left"


@pytest.mark.slow
def test_the_dry_run_ends_well(tmp_path, monkeypatch):
    own = [p for p in pieces("cpu", True) if p.name in ("system", "training stages", "official network, bfloat16")]
    monkeypatch.setattr(cuda, "pieces", lambda device, dry: own)
    monkeypatch.chdir(Path(cuda.ROOT))
    assert main(["--dry-run", "--output", str(tmp_path / "report.md")]) == 0
    text = (tmp_path / "report.md").read_text()
    assert text.count("| ok |") == 3 and '"tiny, monte_carlo"' in text
