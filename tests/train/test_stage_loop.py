"""The loop of the stages: it learns, stops and resumes bitwise equal, in one process or several."""

import json
import signal
import subprocess
import sys
import time

import pytest
import torch
from PIL import Image
from safetensors import safe_open
from torch.distributed.run import get_args_parser

from reli3d.cli.train import main, paper_stage, parsed, parser
from reli3d.nn.presets import TINY
from reli3d.nn.weights import load_model
from reli3d.train import checkpoint
from reli3d.train.log import Log
from reli3d.train.loop import train
from reli3d.train.stages.config import StageConfig
from reli3d.train.stages.losses import gradients
from reli3d.train.stages.stage import PaperStage
from reli3d.train.stages.step import checkpointed, object_losses, total
from reli3d.train.stages.views import Samples, draw
from tests.support.processes import ENVIRONMENT
from tests.support.stages import BallModel, ball_model, numbers, rows

GAUSSIANS = StageConfig("gaussians", "gaussians", 16, lobes=16, batch=2, steps=6, rate=1e-3)


@pytest.fixture(scope="module")
def folder(small_samples):
    return small_samples


def stage_of(folder, model=None, **options):
    return PaperStage(model or ball_model(), GAUSSIANS, [Samples(folder)], folders=[str(folder)], **options)


def options_of(stage, out, **changes):
    return stage.options(str(out), **{"warmup": 2, "save_every": 2, "log_every": 1, **changes})


@pytest.fixture(scope="module")
def whole(folder, tmp_path_factory):
    """The folder of a run of six steps by one thread that is never stopped."""
    out, before = tmp_path_factory.mktemp("whole"), torch.get_num_threads()
    torch.set_num_threads(1)
    stage = stage_of(folder)
    train(stage, options_of(stage, out))
    torch.set_num_threads(before)
    return out


def assert_same_run(one, other):
    """Equal bits in the checkpoint, equal numbers in the log."""
    a, b = (torch.load(folder / "state.pt", weights_only=True) for folder in (one, other))
    for part in ("model", "average"):
        for name, value in a[part].items():
            assert torch.equal(value, b[part][name]), name
    assert numbers(one) == numbers(other)


def test_a_run_learns_logs_and_draws(folder, tmp_path):
    stage = stage_of(folder, validation=Samples(folder))
    draws = [stage.drawn(0, k) for k in range(2)]
    before = [float(total(object_losses(stage.model, d, GAUSSIANS, gradients), GAUSSIANS)) for d in draws]
    train(stage, options_of(stage, tmp_path, save_every=6, steps=16, rate=3e-3))
    after = [float(total(object_losses(stage.model, d, GAUSSIANS, gradients), GAUSSIANS)) for d in draws]
    assert sum(after) < 0.9 * sum(before)
    found = rows(tmp_path)
    assert found[0]["config"]["config"]["lobes"] == 16 and found[-1]["step"] == 16
    assert {"loss", "image", "material", "normal", "sign", "neutral"} < set(found[-1]) and "latent" not in found[-1]
    assert (tmp_path / "validation.png").exists()
    state = checkpoint.load(tmp_path / "state.pt")
    assert json.loads(state["about"]) == found[0]["config"] and state["measures"] == {"surface": 1.0}


def test_stopped_and_continued_is_the_same_run(folder, whole, tmp_path, threads):
    threads(1)
    part, other = stage_of(folder), stage_of(folder, ball_model(7))
    batch = part.batch
    part.batch = lambda step, objects: batch(step, objects) if step < 3 else 1 / 0  # a checkpoint is of step 2
    with pytest.raises(ZeroDivisionError):
        train(part, options_of(part, tmp_path / "parts"))
    train(other, options_of(other, tmp_path / "parts"))  # other parameters, which the checkpoint replaces
    assert_same_run(whole, tmp_path / "parts")


WORKER = """
import sys
import torch
from PIL import Image
from pathlib import Path
from reli3d.train.loop import train
from reli3d.train.stages.config import StageConfig
from reli3d.train.stages.stage import PaperStage
from reli3d.train.stages.views import Samples
from reli3d.train.workers import Workers
from tests.support.stages import ball_model
torch.set_num_threads(1)
folder, out, steps = sys.argv[1:]
config = StageConfig("gaussians", "gaussians", 16, lobes=16, batch=2, rate=1e-3)
workers = Workers.join()
stage = PaperStage(ball_model(), config, [Samples(Path(folder))])
train(stage, stage.options(out, steps=int(steps), warmup=2, save_every=2, log_every=1), workers)
workers.leave()
"""


def test_two_processes_have_the_losses_of_one(folder, tmp_path):
    script = tmp_path / "worker.py"
    script.write_text(WORKER)
    group = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2", script]
    call = [*group, folder, tmp_path / "two", "3"]
    subprocess.run(call, env=ENVIRONMENT, check=True, capture_output=True, timeout=300)
    stage = stage_of(folder)
    train(stage, options_of(stage, tmp_path / "one", steps=3))
    one, two = (numbers(tmp_path / n) for n in ("one", "two"))
    assert len(one) == len(two) == 3
    for a, b in zip(one, two, strict=True):
        for name in a:
            assert b[name] == pytest.approx(a[name], rel=1e-3, abs=2e-6), name  # float32 sums in another order


def test_killed_at_any_moment_a_run_resumes_as_if_never_stopped(folder, whole, tmp_path, threads):
    (tmp_path / "worker.py").write_text(WORKER)
    log = tmp_path / "killed" / "log.jsonl"
    call = [sys.executable, tmp_path / "worker.py", folder, log.parent, "6"]
    with subprocess.Popen(call, env=ENVIRONMENT, stderr=subprocess.DEVNULL) as process:
        end = time.monotonic() + 240
        while process.poll() is None and time.monotonic() < end:
            if log.exists() and len(log.read_text().splitlines()) > 3:  # between two checkpoints
                process.send_signal(signal.SIGKILL)
                break
            time.sleep(0.01)
    threads(1)
    stage = stage_of(folder, ball_model(7))
    train(stage, options_of(stage, log.parent))
    assert_same_run(whole, log.parent)


def test_a_log_drops_half_written_and_repeated_lines(tmp_path):
    path = tmp_path / "log.jsonl"
    path.write_text('{"step": 1, "loss": 1.0}\n{"step": 2, "loss": 1.0}\n{"step": 3, "lo')
    Log(path, 1, {}).close()
    assert [json.loads(line)["step"] for line in path.read_text().splitlines()] == [1, 1]


def test_steps_without_finite_gradients_are_left_out_and_end_a_run(folder, tmp_path):
    stage = stage_of(folder)
    before = {k: v.clone() for k, v in stage.model.state_dict().items()}
    finite = stage.losses
    stage.losses = lambda item: {n: v * float("nan") for n, v in finite(item).items()}
    with pytest.raises(RuntimeError, match="gradients: expected finite ones, got none in 3 steps"):
        train(stage, options_of(stage, tmp_path, bad_steps=3))
    assert all(torch.equal(v, before[k]) for k, v in stage.model.state_dict().items())


def test_a_stage_of_the_surface_ends_at_once_without_one(folder, tmp_path, capsys):
    """As by the command from scratch: only sign and latents would be trained.  From the volume it is reported."""
    few = ["--steps", "1", "--batch", "1", "--image-size", "16", "--lobes", "8"]
    assert main([str(folder), str(tmp_path / "direct"), "--stage", "gaussians", *few]) == 2
    found = capsys.readouterr().err
    assert "expected a network that predicts a surface, got none for 4 training objects" in found
    assert "--stage volume (1500 steps by default)" in found and not (tmp_path / "direct" / "state.pt").exists()
    volume = tmp_path / "volume"
    assert main([str(folder), str(volume), "--stage", "volume", "--patch", "8", *few]) == 0
    assert "surface 0" in capsys.readouterr().err
    assert main([str(volume), "--stage", "volume", "--export", str(tmp_path / "x.safetensors")]) == 2
    assert "got none for 4 training objects" in capsys.readouterr().err and not (tmp_path / "x.safetensors").exists()


def test_checkpointing_and_bfloat16_keep_the_loss(folder):
    """Checkpointing computes the same; bfloat16 has eight bits, so the loss moves by some thousandths."""
    one = draw([Samples(folder)], (0, 1), inputs=2, targets=1, background=0.5, input_size=32, target_size=16, patch=0)
    results = []
    for again, half in ((False, False), (True, False), (False, True)):
        model = ball_model()
        if again:
            checkpointed(model)
        loss = total(object_losses(model, one, GAUSSIANS, gradients, bfloat16=half), GAUSSIANS)
        loss.backward()
        results.append((float(loss), model.bank.embeddings.grad.clone()))
    assert results[0][0] == results[1][0] and torch.equal(results[0][1], results[1][1])
    assert results[2][0] == pytest.approx(results[0][0], rel=0.02)
    cosine = torch.nn.functional.cosine_similarity(results[0][1].reshape(1, -1), results[2][1].reshape(1, -1))
    assert float(cosine) > 0.97


def test_a_checkpoint_is_exported_and_starts_the_next_stage(folder, tmp_path):
    torch.manual_seed(0)
    stage = stage_of(folder, BallModel(TINY))
    train(stage, options_of(stage, tmp_path / "one", steps=0))
    state = tmp_path / "one" / "state.pt"
    average = checkpoint.load(state)["average"]
    exported = str(tmp_path / "x.safetensors")
    assert main([str(state.parent), "--stage", "gaussians", "--export", exported, "--license", "CC0-1.0"]) == 0
    with safe_open(exported, "pt") as file:
        assert file.metadata()["licence"] == "CC0-1.0"
    model = load_model(exported)
    assert model.preset.name == "tiny"  # stored in half precision
    torch.testing.assert_close(model.bank.embeddings, average["bank.embeddings"], rtol=1e-3, atol=1e-4)
    call = [str(folder), str(tmp_path / "two"), "--stage", "volume", "--steps", "0", "--weights", str(state)]
    assert main(call) == 0
    begun = checkpoint.load(tmp_path / "two" / "state.pt")["model"]
    assert all(torch.equal(value, average[name]) for name, value in begun.items())


def test_tensorboard_has_the_numbers_of_the_log_and_the_images(folder, tmp_path):
    pytest.importorskip("tensorboard")
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    for steps in (2, 4):  # the second run resumes at step 2
        stage = stage_of(folder, validation=Samples(folder))
        train(stage, options_of(stage, tmp_path / "run", steps=steps, tensorboard=str(tmp_path / "board")))
    found = EventAccumulator(str(tmp_path / "board"), {"images": 0, "scalars": 0})
    found.Reload()
    logged = numbers(tmp_path / "run")
    assert [r["step"] for r in logged] == [1, 2, 3, 4]
    for name in ("loss", "image", "rate"):
        events = found.Scalars(name)
        assert [e.step for e in events] == [1, 2, 3, 4]
        assert [e.value for e in events] == pytest.approx([r[name] for r in logged], rel=1e-6)  # float32
    images = found.Images("validation")
    with Image.open(tmp_path / "run" / "validation.png") as grid:
        assert [e.step for e in images] == [2, 4] and (images[-1].width, images[-1].height) == grid.size


def test_a_missing_tensorboard_is_reported_in_one_line(folder, tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "torch.utils.tensorboard", None)  # its import raises
    assert main([str(folder), str(tmp_path / "run"), "--tensorboard", str(tmp_path / "board")]) == 2
    found = capsys.readouterr().err
    assert found.endswith("got none; pip install tensorboard\n") and found.count("\n") == 1
    assert not (tmp_path / "run").exists()


def test_the_strategies_of_a_stage_can_be_chosen(folder, tmp_path):
    call = [str(folder), str(tmp_path), "--stage", "monte_carlo", "--samples", "16", "0", "0", "--no-shadows"]
    config = paper_stage(parsed(call)).config
    assert config.samples == (16, 0, 0) and not config.shadows
    plain = paper_stage(parsed(call[:4])).config
    assert plain.samples == (6, 8, 2) and plain.shadows


def test_no_option_is_the_beginning_of_one_of_torchruns():
    """torchrun looks at the whole line, and takes such an option for its own or calls it ambiguous."""
    theirs = [o for action in get_args_parser()._actions for o in action.option_strings]
    ours = [o for action in parser()._actions for o in action.option_strings if o not in ("-h", "--help")]
    assert "--start-method" in theirs and "--weights" in ours
    assert [o for o in ours if any(t.startswith(o) for t in theirs)] == []
