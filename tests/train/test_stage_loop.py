"""The loop of the stages: it learns, stops and goes on with the same bits, alone or with others."""

import json
import os
import random
import signal
import subprocess
import sys
import time
import warnings
from dataclasses import replace

import pytest
import torch
from PIL import Image
from torch.distributed.run import get_args_parser

from reli3d.cli import stages
from reli3d.errors import InputError
from reli3d.nn.model import Reconstructor
from reli3d.nn.weights import load_model
from reli3d.train.pictures import HEIGHT, write_curves
from reli3d.train.stages import loop
from reli3d.train.stages.config import Run, Stage
from reli3d.train.stages.loop import drawn, load_state, open_log, train
from reli3d.train.stages.losses import gradients
from reli3d.train.stages.step import checkpointed, object_losses, total
from reli3d.train.stages.views import Samples, draw
from tests.support.stages import SMALL, ball_model, write_samples

GAUSSIANS = Stage("gaussians", "gaussians", 16, lobes=16, batch=2, steps=6, rate=1e-3)
SIZES = dict(inputs=2, targets=1, background=0.5, input_size=32, target_size=16, patch=0)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return write_samples(tmp_path_factory.mktemp("loop"))


def run_of(folder, out, **changes):
    return Run((str(folder),), str(out), GAUSSIANS, **{"warmup": 2, "save_every": 2, "log_every": 1, **changes})


def rows(folder):
    return [json.loads(line) for line in (folder / "log.jsonl").read_text().splitlines()]


def test_a_run_learns_logs_and_draws(folder, tmp_path):
    run = run_of(folder, tmp_path, save_every=6)
    run = replace(run, stage=replace(run.stage, steps=16, rate=3e-3))
    model, source = ball_model(), Samples(folder)
    held = [drawn(run, [source], model, 0, k) for k in range(2)]
    before = [float(total(object_losses(model, d, run.stage, gradients), run.stage)) for d in held]
    train(model, run, [source], held_back=held)
    after = [float(total(object_losses(model, d, run.stage, gradients), run.stage)) for d in held]
    assert sum(after) < 0.9 * sum(before)
    found = rows(tmp_path)
    assert found[0]["config"]["stage"]["lobes"] == 16 and found[-1]["step"] == 16
    assert {"loss", "image", "material", "normal", "sign", "neutral"} < set(found[-1]) and "latent" not in found[-1]
    assert (tmp_path / "curves.png").exists() and (tmp_path / "pictures.png").exists()
    assert json.loads(load_state(tmp_path / "state.pt", model)["run"]) == json.loads(run.text())


def test_stopped_and_continued_is_the_same_run(folder, tmp_path):
    whole, parts = run_of(folder, tmp_path / "whole"), run_of(folder, tmp_path / "parts")
    train(ball_model(), whole, [Samples(folder)])
    saved = loop.save

    def stop(*args):
        saved(*args)
        if args[4] == 4:
            raise KeyboardInterrupt

    loop.save = stop
    try:
        with pytest.raises(KeyboardInterrupt):
            train(ball_model(), parts, [Samples(folder)])
    finally:
        loop.save = saved
    train(ball_model(7), parts, [Samples(folder)])  # other parameters, which the checkpoint replaces
    of = {name: torch.load(tmp_path / name / "state.pt", weights_only=True) for name in ("whole", "parts")}
    for part in ("model", "average"):
        for name, value in of["whole"][part].items():
            assert torch.equal(value, of["parts"][part][name]), name
    losses = [[r for r in rows(tmp_path / n) if "config" not in r] for n in ("whole", "parts")]
    assert losses[0] == losses[1]


def test_a_stage_starts_from_the_average_of_the_one_before(folder, tmp_path):
    first = run_of(folder, tmp_path / "one")
    train(ball_model(), first, [Samples(folder)])
    average = load_state(tmp_path / "one" / "state.pt", ball_model())["average"]
    stage = Stage("monte_carlo", "monte_carlo", 16, samples=(2, 2, 0), batch=1, steps=0)
    second = replace(run_of(folder, tmp_path / "two"), stage=stage, start=str(tmp_path / "one" / "state.pt"))
    model = ball_model(5)
    train(model, second, [Samples(folder)])
    for name, value in model.state_dict().items():
        assert torch.equal(value, average[name]), name


def test_two_shares_of_a_batch_add_up_to_the_whole(folder, tmp_path):
    """What the processes of a group have, one after the other here: their mean is the gradient of one process."""
    run, source = run_of(folder, tmp_path), Samples(folder)
    draws = [drawn(run, [source], ball_model(), 3, k) for k in range(4)]
    grads = []
    for parts in ([draws], [draws[:2], draws[2:]]):
        means = 0.0
        for part in parts:
            model = ball_model()
            loop.accumulate(model, run, part, gradients, len(part))
            flat = [torch.zeros_like(p) if p.grad is None else p.grad for p in model.parameters()]
            means = means + torch.cat([g.reshape(-1) for g in flat]) / len(parts)
        grads.append(means)
    torch.testing.assert_close(*grads, rtol=1e-4, atol=1e-6)  # float32 sums in another order


WORKER = """
import sys
import torch
from PIL import Image
from pathlib import Path
from reli3d.train.stages.config import Run, Stage
from reli3d.train.stages.loop import train
from reli3d.train.stages.views import Samples
from reli3d.train.workers import Workers
from tests.support.stages import ball_model
torch.set_num_threads(1)
folder, out, steps = sys.argv[1:]
stage = Stage("gaussians", "gaussians", 16, lobes=16, batch=2, steps=int(steps), rate=1e-3)
workers = Workers.join()
train(ball_model(), Run((folder,), out, stage, warmup=2, save_every=2, log_every=1), [Samples(Path(folder))], workers)
workers.leave()
"""


def test_two_processes_have_the_losses_of_one(folder, tmp_path):
    script = tmp_path / "worker.py"
    script.write_text(WORKER)
    env = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path), "OMP_NUM_THREADS": "1"}
    group = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2", script]
    for name, start in (("one", [sys.executable, script]), ("two", group)):
        subprocess.run([*start, folder, tmp_path / name, "3"], env=env, check=True, capture_output=True, timeout=300)
    one, two = ([r for r in rows(tmp_path / n) if "config" not in r] for n in ("one", "two"))
    assert len(one) == len(two) == 3
    for a, b in zip(one, two, strict=True):
        for name in a:
            assert b[name] == pytest.approx(a[name], rel=1e-3, abs=2e-6), name  # float32 sums in another order


def test_killed_at_any_moment_a_run_goes_on_as_if_never_stopped(folder, tmp_path):
    script = tmp_path / "worker.py"
    script.write_text(WORKER)
    env = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path), "OMP_NUM_THREADS": "1"}
    call = [sys.executable, script, folder]
    subprocess.run([*call, tmp_path / "whole", "6"], env=env, check=True, capture_output=True, timeout=300)
    state = tmp_path / "killed" / "state.pt"
    with subprocess.Popen([*call, state.parent, "6"], env=env, stderr=subprocess.DEVNULL) as process:
        end = time.monotonic() + 240
        while process.poll() is None and time.monotonic() < end:
            log = state.parent / "log.jsonl"
            if log.exists() and len(log.read_text().splitlines()) > 3:  # between two checkpoints
                process.send_signal(signal.SIGKILL)
                break
            time.sleep(0.01)
    subprocess.run([*call, state.parent, "6"], env=env, check=True, capture_output=True, timeout=300)
    a, b = (torch.load(tmp_path / n / "state.pt", weights_only=True) for n in ("whole", "killed"))
    assert all(torch.equal(v, b["model"][k]) for k, v in a["model"].items())
    losses = [[r for r in rows(tmp_path / n) if "config" not in r] for n in ("whole", "killed")]
    assert losses[0] == losses[1]


@pytest.mark.slow
def test_killed_twenty_times_a_run_has_the_curve_of_one_that_never_was(folder, tmp_path):
    (tmp_path / "worker.py").write_text(WORKER)
    env = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path), "OMP_NUM_THREADS": "1"}
    call = [sys.executable, tmp_path / "worker.py", folder]
    subprocess.run([*call, tmp_path / "whole", "300"], env=env, check=True, capture_output=True, timeout=300)
    out, rng = tmp_path / "killed", random.Random(0)
    for _ in range(20):
        log = out / "log.jsonl"
        until = rng.randrange(5) + (log.read_bytes().count(b"\n") if log.exists() else 0)
        with subprocess.Popen([*call, out, "300"], env=env, stderr=subprocess.DEVNULL) as process:
            end = time.monotonic() + 120
            while process.poll() is None and time.monotonic() < end:
                if log.exists() and log.read_bytes().count(b"\n") >= until:
                    break
                time.sleep(0.005)
            time.sleep(rng.uniform(0.0, 0.5))  # also while a checkpoint is written
            assert process.poll() is None
            process.send_signal(signal.SIGKILL)
        if (out / "state.pt").exists():
            load_state(out / "state.pt", ball_model())  # whole
    subprocess.run([*call, out, "300"], env=env, check=True, capture_output=True, timeout=300)
    a, b = (torch.load(tmp_path / n / "state.pt", weights_only=True) for n in ("whole", "killed"))
    assert all(torch.equal(v, b["model"][k]) for k, v in a["model"].items())
    losses = [[r for r in rows(tmp_path / n) if "config" not in r] for n in ("whole", "killed")]
    assert losses[0] == losses[1]


def test_a_log_loses_what_was_half_written_and_what_comes_again(tmp_path):
    run = Run(("x",), str(tmp_path), GAUSSIANS)
    path = tmp_path / "log.jsonl"
    path.write_text('{"step": 1, "loss": 1.0}\n{"step": 2, "loss": 1.0}\n{"step": 3, "lo')
    open_log(path, 1, run).close()
    assert [json.loads(line)["step"] for line in path.read_text().splitlines()] == [1, 1]


def test_steps_without_finite_gradients_are_left_out_and_end_a_run(folder, tmp_path, monkeypatch):
    run = replace(run_of(folder, tmp_path), bad_steps=3)
    model = ball_model()
    before = {k: v.clone() for k, v in model.state_dict().items()}
    broken = loop.object_losses
    monkeypatch.setattr(
        loop, "object_losses", lambda *a, **k: {n: v * float("nan") for n, v in broken(*a, **k).items()}
    )
    with pytest.raises(RuntimeError, match="gradients: expected finite ones, got none in 3 steps"):
        train(model, run, [Samples(folder)])
    assert all(torch.equal(v, before[k]) for k, v in model.state_dict().items())


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04 nothing", None])
def test_a_broken_or_foreign_checkpoint_is_refused_in_one_line(content, tmp_path):
    path = tmp_path / "state.pt"
    if content is None:
        torch.save({"preset": "{}", "step": 1}, path)
    else:
        path.write_bytes(content)
    with pytest.raises(InputError, match="expected a checkpoint of"):
        load_state(path, ball_model())


def test_checkpointing_and_bfloat16_keep_the_loss(folder):
    """Checkpointing computes the same; bfloat16 has eight bits, so the loss moves by some thousandths."""
    one = draw([Samples(folder)], (0, 1), **SIZES)
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


def test_the_average_is_a_network_of_its_own():
    model = ball_model()
    other = loop.averaged(model, model.state_dict())
    assert isinstance(other, Reconstructor) and other.preset is SMALL and not other.training


def test_the_command_trains_and_exports_what_the_pipeline_loads(folder, tmp_path, capsys):
    out = tmp_path / "run"
    small = ["--steps", "1", "--batch", "1", "--image-size", "16", "--patch", "8", "--lobes", "8"]
    assert stages.main(["volume", str(out), str(folder), *small]) == 0
    assert '"lobes": 8' in capsys.readouterr().err  # the configuration is printed
    assert stages.main(["volume", str(out), "--export", str(tmp_path / "x.safetensors")]) == 0
    model = load_model(str(tmp_path / "x.safetensors"))
    state = torch.load(out / "state.pt", weights_only=True)
    assert model.preset.name == "tiny"  # stored in half precision
    want = state["average"]["bank.embeddings"]
    torch.testing.assert_close(model.bank.embeddings.detach(), want, rtol=1e-3, atol=1e-4)


def test_tensorboard_has_the_numbers_of_the_log_and_the_pictures(folder, tmp_path):
    pytest.importorskip("tensorboard")
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    run = replace(run_of(folder, tmp_path / "run"), tensorboard=str(tmp_path / "board"))
    run = replace(run, stage=replace(run.stage, steps=2))
    source = Samples(folder)
    train(ball_model(), run, [source], held_back=[drawn(run, [source], ball_model(), 0, 0)])
    run = replace(run, stage=replace(run.stage, steps=4))
    train(ball_model(), run, [source], held_back=[drawn(run, [source], ball_model(), 0, 0)])  # goes on at step 2
    found = EventAccumulator(str(tmp_path / "board"), {"images": 0, "scalars": 0})
    found.Reload()
    logged = [r for r in rows(tmp_path / "run") if "config" not in r]
    assert [r["step"] for r in logged] == [1, 2, 3, 4]
    for name in ("loss", "image", "rate"):
        events = found.Scalars(name)
        assert [e.step for e in events] == [1, 2, 3, 4]
        assert [e.value for e in events] == pytest.approx([r[name] for r in logged], rel=1e-6)  # float32
    pictures = found.Images("pictures")
    with Image.open(tmp_path / "run" / "pictures.png") as grid:
        assert [e.step for e in pictures] == [2, 4] and (pictures[-1].width, pictures[-1].height) == grid.size


def test_tensorboard_that_is_missing_is_told_in_one_line(folder, tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "torch.utils.tensorboard", None)  # its import raises
    call = ["volume", str(tmp_path / "run"), str(folder), "--tensorboard", str(tmp_path / "board")]
    assert stages.main(call) == 2
    told = capsys.readouterr().err
    assert told.endswith("got none; pip install tensorboard\n") and told.count("\n") == 1
    assert not (tmp_path / "run").exists()


def test_the_strategies_of_a_stage_can_be_chosen(folder, tmp_path):
    call = ["monte_carlo", str(tmp_path), str(folder), "--samples", "16", "0", "0", "--no-shadows"]
    stage = stages.run_of(stages.parser().parse_args(call)).stage
    assert stage.samples == (16, 0, 0) and not stage.shadows
    plain = stages.run_of(stages.parser().parse_args(call[:3])).stage
    assert plain.samples == (6, 8, 2) and plain.shadows


def test_curves_leave_out_what_is_nowhere_finite(tmp_path):
    rows = [{"step": k, "loss": 1.0 / k, "norm": float("nan"), "rate": 0.1, "image": k - 1.0} for k in (1, 2, 3)]
    (tmp_path / "log").write_text("".join(json.dumps(r) + "\n" for r in rows))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        write_curves(tmp_path / "log", tmp_path / "curves.png")
    with Image.open(tmp_path / "curves.png") as sheet:  # three panels are one row, four would be two
        assert sheet.height == HEIGHT


def test_no_option_is_the_beginning_of_one_of_torchruns():
    """torchrun looks at the whole line, and takes such an option for its own or calls it ambiguous."""
    theirs = [o for action in get_args_parser()._actions for o in action.option_strings]
    ours = [o for action in stages.parser()._actions for o in action.option_strings if o not in ("-h", "--help")]
    assert "--start-method" in theirs and "--start-from" in ours
    assert [o for o in ours if any(t.startswith(o) for t in theirs)] == []
