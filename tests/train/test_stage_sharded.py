"""Parameters of the trunk in parts on two processes: the losses of one process, and checkpoints that either reads."""

import contextlib
import json

import pytest
import torch

from reli3d.cli.train import main
from reli3d.train.loop import train
from reli3d.train.stages.config import StageConfig
from reli3d.train.stages.stage import PaperStage
from reli3d.train.stages.step import trunk_layers
from reli3d.train.stages.views import Samples
from tests.support.processes import on_two
from tests.support.stages import ball_model, numbers

CONFIG = StageConfig("gaussians", "gaussians", 16, lobes=16, batch=2, steps=4, rate=1e-3)
STEPS = dict(warmup=2, save_every=2, log_every=1)
WORKER = """
import copy
import gc
import json
import sys
from pathlib import Path
import torch
from torch import nn
from torch.distributed.tensor import DTensor
from reli3d.train.loop import train
from reli3d.train.sharded import clip_gradients, gathered, scattered, shard
from reli3d.train.stages.config import StageConfig
from reli3d.train.stages.stage import PaperStage
from reli3d.train.stages.views import Samples
from reli3d.train.workers import Workers
from tests.support.stages import ball_model
torch.set_num_threads(1)
folder, out, stop = sys.argv[1:]
class Stops(PaperStage):
    def batch(self, step, objects):
        if step == int(stop) - 1:
            record_shards()
        if step == int(stop):
            workers.leave()
        return super().batch(step, objects)
def record_shards():
    optimizer = next(o for o in gc.get_objects() if isinstance(o, torch.optim.AdamW))
    cut = [p for p in stage.model.parameters() if isinstance(p, DTensor)]
    moments = [v for s in optimizer.state.values() for v in s.values() if isinstance(v, DTensor)]
    here = [sum(t.to_local().numel() for t in ts) / sum(t.numel() for t in ts) for ts in (cut, moments)]
    Path(out, f"shards.{workers.rank}").write_text(json.dumps([len(cut), *here]))
def check_clipping():
    torch.manual_seed(0)
    whole = nn.Sequential(nn.Linear(5, 7), nn.Linear(7, 3))
    cut = copy.deepcopy(whole)
    shard([cut[0]], torch.device("cpu"))
    x = torch.randn(4, 5)
    for model in (whole, cut):
        model(x).square().sum().backward()
    for limit in (1e3, 0.1):  # not reached, reached
        expected = nn.utils.clip_grad_norm_(whole.parameters(), limit)
        torch.testing.assert_close(clip_gradients(list(cut.parameters()), limit), expected)
        for a, b in zip(whole.parameters(), cut.parameters()):
            torch.testing.assert_close(gathered(b.grad, True), a.grad)
    for a, b in zip(whole.parameters(), cut.parameters()):
        assert torch.equal(gathered(scattered(a.detach() + 1, b), True), a.detach() + 1)
    Path(out).mkdir(exist_ok=True)
    Path(out, f"clipped.{workers.rank}").touch()
config = StageConfig("gaussians", "gaussians", 16, lobes=16, batch=2, steps=4, rate=1e-3)
workers = Workers.join()
check_clipping()
stage = Stops(ball_model(), config, [Samples(Path(folder))], checkpointing=True)
train(stage, stage.options(out, warmup=2, save_every=2, log_every=1, shard=True), workers)
workers.leave()
"""


@pytest.fixture(scope="module")
def folder(small_samples):
    return small_samples


def alone(folder, out, stop=None):
    """The run of one process, ended after the checkpoint of step ``stop``."""

    class Stops(PaperStage):
        def batch(self, step, objects):
            if step == stop:
                raise KeyboardInterrupt
            return super().batch(step, objects)

    stage = Stops(ball_model(), CONFIG, [Samples(folder)])
    with contextlib.suppress(KeyboardInterrupt):
        train(stage, stage.options(str(out), **STEPS))


@pytest.fixture(scope="module")
def runs(folder, tmp_path_factory):
    """``one`` by one process; ``first`` begun in parts and ended by one process; ``last`` the other way."""
    root = tmp_path_factory.mktemp("runs")
    script = root / "worker.py"
    script.write_text(WORKER)
    alone(folder, root / "one")
    on_two(script, folder, root / "first", 2)
    state = torch.load(root / "first" / "state.pt", weights_only=True)
    alone(folder, root / "first")
    alone(folder, root / "last", 2)
    on_two(script, folder, root / "last", 4)
    return root, state


def test_losses_and_parameters_are_those_of_one_process_and_either_resumes(runs):
    root, _ = runs
    one = numbers(root / "one")
    end = torch.load(root / "one" / "state.pt", weights_only=True)
    for name in ("first", "last"):
        found = numbers(root / name)
        assert [r["step"] for r in found] == [1, 2, 3, 4]
        for a, b in zip(one, found, strict=True):
            for key in a:  # float32 sums in another order, enlarged by Adam: its first steps have the rate's size
                assert b[key] == pytest.approx(a[key], rel=2e-3, abs=5e-6), (name, a["step"], key)
        state = torch.load(root / name / "state.pt", weights_only=True)
        for part in ("model", "average"):
            for key, value in end[part].items():
                # Adam moves parameters with nearly no gradient by up to the rate, either way: two steps of 1e-3
                torch.testing.assert_close(state[part][key], value, rtol=0, atol=2e-3)
                assert float((state[part][key] - value).abs().mean()) < 5e-5, key


def test_a_checkpoint_is_whole(runs):
    _, state = runs
    model = ball_model()
    for part in ("model", "average"):
        assert {k: v.shape for k, v in state[part].items()} == {k: v.shape for k, v in model.state_dict().items()}
    assert all(type(v) is torch.Tensor for v in state["model"].values())
    sizes = [p.shape for g in (True, False) for p in model.parameters() if (p.ndim > 1) == g and p.requires_grad]
    found = state["optimizer"]["state"]
    assert [found[k]["exp_avg"].shape for k in range(len(sizes))] == sizes
    assert float(found[0]["step"]) == 2.0


def test_each_process_has_half_of_the_layers_and_of_their_moments(runs):
    root, _ = runs
    count = sum(len(list(layer.parameters())) for layer in trunk_layers(ball_model()))
    for name in ("first", "last"):
        for rank in range(2):
            found, parameters, moments = json.loads((root / name / f"shards.{rank}").read_text())
            assert found == count and 0.49 < parameters < 0.51 and 0.49 < moments < 0.51  # odd rows are rounded up


def test_one_process_alone_is_refused(folder, tmp_path, capsys):
    assert main([str(folder), str(tmp_path / "out"), "--stage", "gaussians", "--shard", "--steps", "1"]) == 2
    assert "shard: expected several processes" in capsys.readouterr().err


def test_norms_and_parts_are_those_of_whole_gradients(runs):
    """Against torch's own clipping of the whole module, on the same input on both processes."""
    root, _ = runs
    assert all((root / "first" / f"clipped.{rank}").exists() for rank in range(2))
