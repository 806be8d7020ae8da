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
    (tmp_path / "empty").mkdir()
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


EXAMPLE = [str(infer.EXAMPLE), "--output", "out"]
RENDER = ["render", "out", "--maps", "maps.npz"]


def named(command, start: list[str], options: str) -> list[tuple]:
    """Cases of a few words each, separated by commas, whose message names the option."""
    return [(command, [*start, *words.split()], words.split()[0]) for words in options.split(",")]


CASES = [
    *named(render, ["x.glb"], "--samples -1 0 4, --samples 0 0 0, --samples 99999999999 1 1, --seed -1, --size 0"),
    *named(render, ["x.glb"], "--seed 99999999999999999999, --elevation 90, --azimuth nan, --exposure nan"),
    *named(render, ["x.glb"], "--distance inf, --device cuda:99"),
    *(
        (render, ["x.glb", *options], word)
        for options, word in [
            (["--output", "file"], "a file"),
            (["--output", "turn.mov"], "expected a folder or a file of type .png"),
            (["--output", "turn.png", "--frames", "4"], "--frames: expected 1 where --output names one png, got 4"),
            ([], "not found"),
            (["--diffuse-model", "white"], "arguments: "),
            (["--output", "a.gif", "--format", "png"], "--format: expected gif"),
            (["--output", "a.mp4", "--size", "47"], "--size: expected an even number"),
        ]
    ),
    *named(infer, EXAMPLE, "--texture-size 100, --resolution 4, --views 0, --workers 0, --refine -1, --refine 0steps"),
    *named(infer, EXAMPLE, "--refine soon, --refine-cameras"),
    *(
        (infer, [*EXAMPLE, *options], word)
        for options, word in [
            (["--workers", "2", "--ray", "auto"], "--ray"),
            (["--weights", "nowhere.safetensors"], "nowhere.safetensors"),
            (["--light", "camera"], "add --refine"),
            (["--no-such-option"], "arguments: "),
            (["--device", "abacus"], "arguments: "),
            (["--views", "many"], "arguments: "),
        ]
    ),
    (infer, ["input", "--output", "."], "mesh.glb would be replaced"),
    (infer, ["input", "empty", "--output", "out", "--masks", "empty"], "--masks: expected one object"),
    (infer, ["input/transforms.json", "--output", "out"], "got a camera file; give input"),
    (infer, [".", "--output", ".."], "expected a folder other than the working one"),
    *named(data, RENDER, "--workers 0, --first -5, --count 0, --views 0, --size 0"),
    *named(data, ["pack", "good", "out"], "--each 0"),
    (data, ["render", "out", "--maps", "few.npz", "--held-out", "test"], "--maps"),
    *(
        (data, ["render", "out", "--maps", *options], word)
        for options, word in [
            (["none.npz"], "not found"),
            (["file"], "broken file"),
            (["cut.npz"], "broken file"),
            (["key.npz"], "env"),
            (["pickle.npz"], "broken file"),
            (["shape.npz"], "env"),
            (["long.npz"], "names"),
            (["/dev/zero"], "regular"),
            (["maps.npz", "--first", "999999999", "--count", "2"], "expected seeds below 1000000000, got 1000000000"),
            (["maps.npz", "--meshes", "none.glb"], "not found"),
            (["maps.npz", "--meshes", "empty"], "expected GLB files"),
            (["maps.npz", "--protocol", "paper", "--views", "8"], "--views: expected none"),
            (["maps.npz", "--protocol", "paper", "--held-out", "test"], "expected at least 3 for --protocol paper"),
            (["maps.npz", "--workers", "2", "--ray", "auto"], "not allowed with"),
            (["maps.npz", "--meshes", "a.glb", "--shapes", "b.glb"], "not allowed with"),
            (["array.npy"], "broken file"),
        ]
    ),
    (data, ["render", "file", "--maps", "maps.npz"], "a file"),
    *named(export, ["x.glb"], "--decimate 3, --texture-size 9"),
    (export, ["x.glb", "--format", "obj", "--textures", "webp"], "--textures: expected png"),
    (data, ["pack", "none", "out"], "none"),
    (data, ["pack", "empty", "out"], "captures"),
    *named(
        train, ["good", "out"], "--batch 0, --steps -1, --minutes nan, --points 0, --max-views 0, --rate nan, --seed -1"
    ),
    *named(train, ["good", "out", "--stage", "volume"], "--steps -1, --rate nan, --max-views 17"),
    (train, ["good", "out", "--stage", "light_prior", "--patch", "8"], "--patch"),
    (train, ["good", "out", "--stage", "pixels", "--image-size", "32"], "--image-size"),
    *(
        (train, ["good", "out", "--stage", *options], word)
        for options, word in [
            (["nothing"], "--stage"),
            (["volume", "--weights", "none.pt"], "none.pt: file not found"),
            (["volume", "--prior", "file"], "broken file"),
            (["light_prior"], "good: "),
            (["volume", "--patch", "999"], "patch"),
            (["small", "--image-size", "8"], "--image-size: expected none for stage small"),
            (["small", "--lobes", "8"], "--lobes: expected none for stage small"),
            (["volume", "--points", "8"], "--points: expected none for stage volume"),
        ]
    ),
    *(
        (train, [folder, "out"], word)
        for folder, word in [
            ("none", "folder of samples"),
            ("file", "folder of samples"),
            ("empty", "got none"),
            ("lacks", "points"),
            ("few", "c2w"),
            ("cut", "broken file"),
            ("nothing", "broken file"),
            ("noise", "broken file"),
        ]
    ),
    *(
        (train, ["good", "out", *options], word)
        for options, word in [
            (["--validation", "cut"], "broken file"),
            (["--weights", "none.pt"], "none.pt: file not found"),
            (["--weights", "run_noise/state.pt"], "broken file"),
            (["--export", "a/b"], "not found"),
            (["--export", "empty"], "expected a file"),
        ]
    ),
    (train, ["good", "file"], "a file"),
    (train, ["good", "run_list"], "another file"),
    (train, ["good", "run_noise"], "broken file"),
    (train, ["good", "run_other"], "run_other/state.pt"),
    (train, ["good", "run_noise", "--export", "x.safetensors"], "broken file"),
    *(
        (evaluation, [folder, "--maps", maps, *options], word)
        for folder, maps, options, word in [
            ("none", "maps.npz", [], "folder of samples"),
            ("named", "maps.npz", [], "seed"),
            ("cut", "maps.npz", [], "broken file"),
            ("empty", "maps.npz", [], "expected *.safetensors"),
            ("good", "cut.npz", [], "broken file"),
            ("good", "maps.npz", ["--json", "file/x"], "a file"),
            ("good", "maps.npz", ["--json", "good"], "a folder"),
            ("good", "maps.npz", ["--weights", "none"], "none"),
            ("good", "maps.npz", ["--views", "8"], "expected at least 16, got 12"),
        ]
    ),
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
    trained = [(train, ["good", "out", "--stage", stage]) for stage in ("small", "pixels", "volume")]
    for command, arguments in [(render, ["x.glb"]), (infer, EXAMPLE), *trained]:
        assert command.main([*arguments, "--device", "cuda"]) == 2
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
