"""Invalid input of the commands: one line, exit code 2, no work."""

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

from reli3d.cli import data, export, infer, render, train
from reli3d.cli import eval as evaluation
from reli3d.errors import InputError
from reli3d.synthetic.stored import OPTIONAL, TENSORS, check_sample

TYPES = {"U8": torch.uint8, "I8": torch.int8, "F16": torch.float16, "F32": torch.float32}


def sample(path, **changed):
    """A sample of twelve small views, all zero; ``changed`` tensors take the place of some, None of none."""
    sizes = {"V": 12, "S": 8, "P": 16, "N": 8}
    tensors = {}
    for name, (axes, dtype) in TENSORS.items():
        tensors[name] = torch.zeros([sizes.get(a) or int(a) for a in axes.split()], dtype=TYPES[dtype])
    path.parent.mkdir(exist_ok=True)
    save_file({k: v for k, v in {**tensors, **changed}.items() if v is not None}, path)


@pytest.fixture
def place(tmp_path, monkeypatch):
    """A folder with good samples, broken ones, maps, broken maps, a file, and checkpoints that are none."""
    monkeypatch.chdir(tmp_path)
    sample(tmp_path / "good/0000000003.safetensors")
    sample(tmp_path / "named/chair.safetensors")
    sample(tmp_path / "lacks/0000000003.safetensors", points=None)
    sample(tmp_path / "few/0000000003.safetensors", c2w=torch.zeros(3, 4, 4))
    whole = (tmp_path / "good/0000000003.safetensors").read_bytes()
    for name, part in (("cut", whole[: len(whole) // 2]), ("nothing", b""), ("noise", b"\x07" * 4000)):
        (tmp_path / name).mkdir()
        (tmp_path / name / "0000000003.safetensors").write_bytes(part)
    (tmp_path / "empty" / "summary.csv").mkdir(parents=True)
    (tmp_path / "example").symlink_to(infer.EXAMPLE)
    (tmp_path / "file").write_text("no maps")
    names = [str(k) for k in range(8)]
    for name, count, width, named in (("maps", 8, 8, 8), ("few", 2, 8, 2), ("long", 2, 8, 8), ("shape", 8, 4, 8)):
        np.savez(tmp_path / f"{name}.npz", env=np.ones((count, 4, width, 3), np.float32), names=names[:named])
    np.savez(tmp_path / "key.npz", maps=np.ones((8, 4, 8, 3), np.float32))
    np.savez(tmp_path / "pickle.npz", env=np.array([{}], dtype=object), names=names)
    np.save(tmp_path / "array.npy", np.ones((8, 4, 8, 3), np.float32))
    (tmp_path / "input").mkdir()
    (tmp_path / "input" / "mesh.glb").write_text("a reference")
    (tmp_path / "input" / "transforms.json").write_text("{}")
    (tmp_path / "cut.npz").write_bytes((tmp_path / "maps.npz").read_bytes()[:300])
    other = {"model": {"x": torch.zeros(2)}, "average": {}, "step": 0, "seconds": 0.0}
    other["optimizer"] = {"param_groups": [{"params": [0], "times": 1.0}]}
    for name, state in (("list", [1]), ("other", other), ("noise", None)):
        (tmp_path / f"run_{name}").mkdir()
        torch.save(state, tmp_path / f"run_{name}" / "state.pt")
    (tmp_path / "run_noise" / "state.pt").write_bytes(b"\x80\x02" * 100)
    return tmp_path


def cases(command, start: str, calls: str, word: str = "") -> list[tuple]:
    """Calls that continue ``start``, separated by commas, and the word of their message: if none, their first word."""
    found = [call.split() for call in calls.split(",")]
    return [(command, [*start.split(), *call], word or call[0]) for call in found]


EXAMPLE, MAPS, GOOD = "example --output out", "render out --maps", "good out"
CASES = [
    *cases(render, "x.glb", "--samples -1 0 4, --samples 0 0 0, --samples 99999999999 1 1, --seed -1, --size 0"),
    *cases(render, "x.glb", "--seed 99999999999999999999, --elevation 90, --azimuth nan, --exposure nan"),
    *cases(render, "x.glb", "--distance inf, --device cuda:99"),
    *cases(render, "", "x.glb", "not found"),
    *cases(render, "x.glb", "--output file", "a file"),
    *cases(render, "x.glb", "--output turn.mov", "expected a folder or a file of type .png"),
    *cases(render, "x.glb --output turn.png", "--frames 4", "--frames: expected 1 where --output names one png, got 4"),
    *cases(render, "x.glb", "--diffuse-model white", "arguments: "),
    *cases(render, "x.glb", "--output a.gif --format png", "--format: expected gif"),
    *cases(render, "x.glb", "--output a.mp4 --size 47", "--size: expected an even number"),
    *cases(infer, EXAMPLE, "--texture-size 100, --resolution 4, --views 0, --workers 0, --refine -1, --refine 0steps"),
    *cases(infer, EXAMPLE, "--refine soon, --refine-cameras"),
    *cases(infer, "example --refine -1", "--output file, --output file/out", "a file"),  # seen before the budget
    *cases(infer, "example --refine -1", f"--output {'n' * 300}", "at most 255 bytes"),
    *cases(infer, f"{EXAMPLE} --workers 2", "--ray auto"),
    *cases(infer, EXAMPLE, "--weights nowhere.safetensors", "nowhere.safetensors"),
    *cases(infer, EXAMPLE, "--light camera", "add --refine"),
    *cases(infer, EXAMPLE, "--no-such-option, --device abacus, --views many", "arguments: "),
    *cases(infer, "input", "--output .", "mesh.glb would be replaced"),
    *cases(infer, "input empty --output out", "--masks empty", "--masks: expected one object"),
    *cases(infer, "input good", "--output empty", "expected a file or none"),
    *cases(infer, "input/transforms.json", "--output out", "got a camera file; give input"),
    *cases(infer, ".", "--output ..", "expected a folder other than the working one"),
    *cases(data, f"{MAPS} maps.npz", "--workers 0, --first -5, --count 0, --views 0, --size 0"),
    *cases(data, MAPS, "few.npz --held-out test", "--maps"),
    *cases(data, MAPS, "none.npz, maps.npz --meshes none.glb", "not found"),
    *cases(data, MAPS, "file, cut.npz, pickle.npz, array.npy", "broken file"),
    *cases(data, MAPS, "key.npz, shape.npz", "env"),
    *cases(data, MAPS, "long.npz", "names"),
    *cases(data, MAPS, "/dev/zero", "regular"),
    *cases(data, MAPS, "maps.npz --first 999999999 --count 2", "expected seeds below 1000000000, got 1000000000"),
    *cases(data, MAPS, "maps.npz --meshes empty", "expected GLB files"),
    *cases(data, MAPS, "maps.npz --protocol paper --views 8", "--views: expected none"),
    *cases(data, MAPS, "maps.npz --protocol paper --held-out test", "expected at least 3 for --protocol paper"),
    *cases(data, MAPS, "maps.npz --workers 2 --ray auto, maps.npz --meshes a.glb --shapes b.glb", "not allowed with"),
    *cases(data, "render", "file --maps maps.npz", "a file"),
    *cases(data, "pack good out", "--each 0"),
    *cases(data, "pack", "none out"),
    *cases(data, "pack", "empty out", "captures"),
    *cases(export, "x.glb", "--decimate 3, --texture-size 9"),
    *cases(export, "x.glb", "--format obj --textures webp", "--textures: expected png"),
    *cases(train, GOOD, "--batch 0, --steps -1, --minutes nan, --points 0, --max-views 0, --rate nan, --seed -1"),
    *cases(train, f"{GOOD} --stage volume", "--steps -1, --rate nan, --max-views 17"),
    *cases(train, f"{GOOD} --stage light_prior", "--patch 8"),
    *cases(train, f"{GOOD} --stage pixels", "--image-size 32"),
    *cases(train, GOOD, "--stage nothing"),
    *cases(train, GOOD, "--stage light_prior", "good: "),
    *cases(train, f"{GOOD} --stage volume", "--patch 999", "patch"),
    *cases(train, f"{GOOD} --stage small", "--image-size 8", "--image-size: expected none for stage small"),
    *cases(train, f"{GOOD} --stage small", "--lobes 8", "--lobes: expected none for stage small"),
    *cases(train, f"{GOOD} --stage volume", "--points 8", "--points: expected none for stage volume"),
    *cases(train, GOOD, "--stage volume --weights none.pt, --weights none.pt", "none.pt: file not found"),
    *cases(train, GOOD, "--stage volume --prior file, --validation cut, --weights run_noise/state.pt", "broken file"),
    *cases(train, GOOD, "--export a/b", "not found"),
    *cases(train, GOOD, "--export empty", "expected a file"),
    *cases(train, "", "none out, file out", "folder of samples"),
    *cases(train, "", "empty out", "got none"),
    *cases(train, "", "lacks out", "points"),
    *cases(train, "", "few out", "c2w"),
    *cases(train, "", "cut out, nothing out, noise out", "broken file"),
    *cases(train, "good", "run_noise, run_noise --export x.safetensors", "broken file"),
    *cases(train, "good", "file", "a file"),
    *cases(train, "good", "run_list", "another file"),
    *cases(train, "good", "run_other", "run_other/state.pt"),
    *cases(evaluation, "", "none --maps maps.npz", "folder of samples"),
    *cases(evaluation, "", "named --maps maps.npz", "seed"),
    *cases(evaluation, "", "cut --maps maps.npz, good --maps cut.npz", "broken file"),
    *cases(evaluation, "", "empty --maps maps.npz", "expected *.safetensors"),
    *cases(evaluation, "good --maps maps.npz", "--json file/x", "a file"),
    *cases(evaluation, "good --maps maps.npz", "--json good", "a folder"),
    *cases(evaluation, "good --maps maps.npz", "--weights none", "none"),
    *cases(evaluation, "good --maps maps.npz", "--views 8", "expected at least 16, got 12"),
]


def before(place):
    return {p: p.stat().st_mtime_ns for p in place.rglob("*")}


def test_wrong_input_ends_with_one_line_that_names_it(place, capsys):
    there = before(place)
    for command, arguments, word in CASES:
        assert command.main(arguments) == 2, arguments
        out, err = capsys.readouterr()
        assert out == "" and err.count("\n") == 1 and word in err, (arguments, err)
        assert err.startswith(f"{command.parser().prog}: ")
        assert before(place) == there, arguments


@pytest.mark.skipif(torch.cuda.is_available(), reason="needs a machine without CUDA")
def test_cuda_that_is_missing_is_reported(place, capsys):
    trained = [(train, f"{GOOD} --stage {stage}") for stage in ("small", "pixels", "volume")]
    for command, start in [(render, "x.glb"), (infer, EXAMPLE), *trained]:
        assert command.main([*start.split(), "--device", "cuda"]) == 2
        assert "expected a CUDA device" in capsys.readouterr().err


def test_a_good_sample_passes_and_each_other_dtype_or_shape_does_not(tmp_path):
    path = tmp_path / "samples" / "1.safetensors"
    sample(path)
    check_sample(path, views=12)
    with pytest.raises(InputError, match="at least 13"):
        check_sample(path, views=13)
    for name, (_, dtype) in TENSORS.items():
        wrong = [torch.zeros(2, 5, 7, 11, 13, dtype=TYPES[dtype]), torch.zeros(1, dtype=torch.int64)]
        for tensor in wrong if name in OPTIONAL else [*wrong, None]:
            sample(path, **{name: tensor})
            with pytest.raises(InputError, match=name):
                check_sample(path)
