"""The command from folders to files: outputs, refusals and exit codes."""

import json
import re
import sys
from pathlib import Path

import pytest
import torch
from PIL import Image

from reli3d.cli import checking as check
from reli3d.cli import infer
from reli3d.cli.options import joined
from reli3d.geometry.camera import Camera
from reli3d.io.glb import read_glb
from reli3d.io.hdr import read_environment
from reli3d.output import results
from reli3d.render.color import srgb_to_linear
from reli3d.render.image import render_asset
from reli3d.render.latlong import lat_long_directions
from reli3d.views.folder import load_views
from tests.support import hostile
from tests.support.example import EXAMPLE, QUICK, moved_example


def command(tmp_path: Path, *arguments) -> int:
    return infer.main([*map(str, arguments), "--output", str(tmp_path / "out"), *QUICK])


@pytest.fixture(scope="module")
def example(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("example")
    assert command(folder) == 0
    return folder / "out" / "example"


def test_the_example_gives_every_file_and_a_closed_mesh(example):
    assert sorted(p.name for p in example.iterdir()) == sorted(results.FILES)
    info = json.loads((example / "run_info.json").read_text())
    assert info["mesh"]["watertight"] and info["mesh"]["manifold"]
    assert info["mesh"]["faces"] > 1000
    assert set(info["seconds"]) >= {"reading", "network", "surface", "textures", "light"}
    assert len(info["weights"]["sha256"]) == 64 and "Apache-2.0" in info["weights"]["license"]


def test_peak_memory_is_none_where_python_has_no_count(monkeypatch):
    """On Windows there is no module ``resource``."""
    assert results.peak_memory_mib() > 10.0  # a Python with torch
    monkeypatch.setitem(sys.modules, "resource", None)  # its import raises
    assert results.peak_memory_mib() is None


def test_both_environments_hold_the_same_light(example):
    exr, hdr = (read_environment(example / f"environment.{kind}").radiance for kind in ("exr", "hdr"))
    assert exr.shape == (32, 64, 3) and bool((exr > 0).all())
    peak = exr.amax(-1, keepdim=True)
    assert bool(((exr - hdr).abs() <= peak / 100).all())  # RGBE keeps 8 bits of the largest channel


def test_its_light_shows_it_as_bright_as_the_photographs(example):
    views, light = load_views(infer.EXAMPLE, views=4), read_environment(example / "environment.exr")
    (asset,) = read_glb(example / "mesh.glb")
    seen, shown = [], []
    for image, mask, c2w, intrinsics in zip(views.images, views.masks, views.c2w, views.intrinsics, strict=True):
        height, width = mask.shape
        rendering = render_asset(asset, Camera(c2w, intrinsics / 8, width // 8, height // 8), light)
        image = torch.nn.functional.avg_pool2d(srgb_to_linear(image).movedim(-1, 0), 8).movedim(0, -1)
        inside = torch.nn.functional.avg_pool2d(mask[None], 8)[0] > 0.999
        both = inside & (rendering.alpha > 0) & (image.amax(-1) < 0.97)
        seen.append(image[both]), shown.append(rendering.radiance[both])
    # without the correction it is half as bright; 10 %: other pixels, of which others are overexposed
    assert float(torch.cat(shown).mean() / torch.cat(seen).mean()) == pytest.approx(1.0, abs=0.1)


def test_the_mesh_follows_the_frame_of_the_cameras(tmp_path):
    matrix = torch.eye(4, dtype=torch.float64)
    matrix[:3, :3] *= 7.0
    matrix[:3, 3] = torch.tensor([30.0, -4.0, 11.0])
    folder = moved_example(tmp_path / "moved", matrix)
    assert command(tmp_path, infer.EXAMPLE, folder, "--normalize", "hull", "--views", "4") == 0
    here, there = (read_glb(tmp_path / "out" / n / "mesh.glb")[0].mesh.vertices.double() for n in ("example", "moved"))
    box = torch.stack([here.amin(0), here.amax(0)]) * 7 + matrix[:3, 3]
    got = torch.stack([there.amin(0), there.amax(0)])
    # the hull's grid starts at another place: its box moves by up to a cell of 3 %, and the network's input with it
    assert float((box - got).abs().max()) < 0.06 * float((box[1] - box[0]).max())


def test_up_turns_mesh_and_light(example, tmp_path):
    assert command(tmp_path, infer.EXAMPLE, "--up", "z") == 0
    here, there = (read_glb(p)[0].mesh.vertices for p in (example / "mesh.glb", tmp_path / "out/example/mesh.glb"))
    torch.testing.assert_close(there, torch.stack([here[:, 0], here[:, 2], -here[:, 1]], -1), rtol=0, atol=1e-6)


def test_hostile_folders_end_with_2_one_line_each_and_no_file(tmp_path, capsys):
    cases = hostile.cases()[::8]  # load_views reads each of them in test_hostile_inputs
    for name, make in cases:
        make(tmp_path / name)
    assert command(tmp_path, *(tmp_path / name for name, _ in cases)) == 2
    out, err = capsys.readouterr()
    lines = [line for line in err.replace("\r", "\n").split("\n") if line.startswith("reli3d-infer: ")]
    assert [line.split(": ")[1] for line in lines] == [name for name, _ in cases]
    assert out == "" and "Traceback" not in err and [p.name for p in (tmp_path / "out").iterdir()] == ["summary.csv"]


def test_one_bad_object_leaves_the_others_bitwise_equal(example, tmp_path, capsys):
    (tmp_path / "bad").mkdir()
    assert command(tmp_path, tmp_path / "bad", infer.EXAMPLE) == 1
    assert results.complete(tmp_path / "out" / "example", infer.EXAMPLE)
    assert capsys.readouterr().out.strip().endswith("mesh.glb")
    for name in ("mesh.glb", "environment.exr", "preview.png"):
        assert (tmp_path / "out/example" / name).read_bytes() == (example / name).read_bytes()
    before = (tmp_path / "out/example/mesh.glb").stat().st_mtime_ns
    assert command(tmp_path, infer.EXAMPLE, "--skip-existing") == 0
    assert (tmp_path / "out/example/mesh.glb").stat().st_mtime_ns == before
    namesake = tmp_path / "other" / "example"
    namesake.mkdir(parents=True)
    capsys.readouterr()
    assert command(tmp_path, namesake, "--skip-existing") == 2
    assert f"got that of '{infer.EXAMPLE}'; give another --output" in capsys.readouterr().err


def test_wrong_cameras_end_the_check_with_3_and_are_named_where_the_reconstruction_fails(tmp_path, capsys):
    folder = moved_example(tmp_path / "object", torch.eye(4, dtype=torch.float64))
    data = json.loads((folder / "transforms.json").read_text())
    for frame in data["frames"]:  # OpenCV's axes where OpenGL's are expected
        frame["transform_matrix"] = [[v * s for v, s in zip(row, (1, -1, -1, 1))] for row in frame["transform_matrix"]]
    (folder / "transforms.json").write_text(json.dumps(data))
    assert check.main([str(folder), "--output", str(tmp_path / "out")]) == 3
    named = "suspect: the camera axes look flipped"
    assert any(line.startswith(named) for line in capsys.readouterr().out.splitlines())
    assert check.main([str(folder), str(infer.EXAMPLE), "--output", str(tmp_path / "out")]) == 3
    assert any(line.startswith("cameras agree") for line in capsys.readouterr().out.splitlines())
    assert command(tmp_path, folder) == 2
    err = capsys.readouterr().err
    assert "\r" not in err  # no bar where there is no terminal
    err = [line for line in err.splitlines() if line.startswith("reli3d-infer: ")]
    assert len(err) == 1 and named in err[0] and "expected" in err[0]


def test_json_is_one_object_on_stdout(tmp_path, capsys):
    (tmp_path / "empty").mkdir()
    folders = [str(infer.EXAMPLE), str(tmp_path / "empty")]
    assert check.main([*folders, "--json", "--output", str(tmp_path / "out")]) == 1
    seen = json.loads(capsys.readouterr().out)
    assert seen["exit_code"] == 1 and [o["object"] for o in seen["objects"]] == ["example", "empty"]
    example, empty = seen["objects"]
    assert example["result"] == "done" and not example["suspect"] and example["verdict"].startswith("cameras agree")
    assert len(example["lines"]) == 12 and Path(example["image"]).stat().st_size > 10_000
    assert empty["result"] == "refused" and "expected transforms.json" in empty["notes"][0]
    assert command(tmp_path, *folders, "--json", "--views", "2") == 1
    made = json.loads(capsys.readouterr().out)["objects"]
    assert [o["result"] for o in made] == ["done", "refused"] and made[0]["faces"] > 1000
    assert (Path(made[0]["folder"]) / "mesh.glb").is_file()


def test_the_check_after_a_reconstruction_leaves_its_log_and_reports_nothing_of_it(tmp_path, capsys):
    result = tmp_path / "out" / "example"
    result.mkdir(parents=True)
    (result / "run_info.json").write_text(json.dumps({"mask_iou": 0.5, "mesh": {"faces": 7}, "notes": ["old"]}))
    log = tmp_path / "out" / "example.reli3d.log"
    log.write_text("Traceback")
    assert check.main([str(infer.EXAMPLE), "--json", "--output", str(tmp_path / "out")]) == 0
    (seen,) = json.loads(capsys.readouterr().out)["objects"]
    assert seen["mask_iou"] is None and seen["faces"] is None and "old" not in seen["notes"] and seen["seconds"] > 0
    assert log.read_text() == "Traceback"


def test_weights_that_ignore_the_background_refuse_it(tmp_path, capsys):
    assert command(tmp_path, "--background", "visible") == 2
    assert "background: expected masked or auto" in capsys.readouterr().err
    assert not any((tmp_path / "out").glob("*/*"))


def test_a_refinement_reads_the_background_or_refuses_cut_outs(tmp_path, capsys):
    words = "--background", "visible", "--views", "4", "--refine", "3steps"
    assert command(tmp_path, *words) == 0
    info = json.loads((tmp_path / "out" / "example" / "run_info.json").read_text())
    assert info["background"] == "visible"
    assert command(tmp_path / "z", *words, "--up", "z") == 0  # the lighting turns with the object
    first = read_environment(tmp_path / "out/example/environment.exr").radiance
    turned = read_environment(tmp_path / "z/out/example/environment.exr")
    directions = lat_long_directions(32)
    turned = turned.lookup(torch.stack([directions[..., 0], directions[..., 2], -directions[..., 1]], -1).contiguous())
    assert float((first.log() - turned.log()).abs().median()) < 0.1
    capsys.readouterr()
    for image in (cut_out := moved_example(tmp_path / "cut_out", torch.eye(4, dtype=torch.float64))).glob("rgba/*.png"):
        bitmap = Image.open(image).convert("RGBA")
        Image.composite(bitmap, Image.new("RGBA", bitmap.size), bitmap.getchannel("A")).save(image)
    assert command(tmp_path / "no", cut_out, *words) == 2
    assert "background: expected content outside the masks for visible" in capsys.readouterr().err
    assert command(tmp_path / "no", *words, "--light", "camera") == 2
    assert "expected lighting that does not move with the camera" in capsys.readouterr().err
    assert not any((tmp_path / "no" / "out").glob("*/*"))


def test_a_negative_axis_may_be_a_word_of_its_own():
    for words in (["--up", "-z"], ["--up=-z"]):
        assert infer.parser().parse_args(joined(["a", *words], "--up", infer.AXES)).up == "-z"
    assert joined(["--up", "z", "-z", "--up"], "--up", infer.AXES) == ["--up=z", "-z", "--up"]


def test_refinement_writes_refine_png_and_its_loss_curve(tmp_path):
    assert command(tmp_path, "--refine", "6steps", "--refine-cameras", "--up", "z", "--views", "3") == 0
    folder = tmp_path / "out" / "example"
    assert sorted(p.name for p in folder.iterdir()) == sorted((*results.FILES, results.COMPARISON))
    info = json.loads((folder / "run_info.json").read_text())
    record = info["refinement"]
    stored = load_views(EXAMPLE, every=True)
    given = dict(zip(stored.names, torch.tensor(info["output_from_input"]).double() @ stored.c2w.double(), strict=True))
    assert [camera["name"] for camera in record["cameras"]] == info["views"]
    for camera in record["cameras"]:  # a few steps move them little
        got = torch.tensor(camera["transform_matrix"]).double()
        torch.testing.assert_close(got, given[camera["name"]], rtol=0, atol=0.05)
    assert sum(record["steps"].values()) == 6 and record["curve"]
    assert set(record["kept"]) == {"surface", "material", "light"}
    assert record["psnr_after"]["input"] is not None and record["views_held_out"] == [1]
    page = (folder / "viewer.html").read_text()
    names = re.findall(r'"name": "(mesh|before|after)"', page)
    assert names == (["after", "before"] if any(record["kept"].values()) else ["mesh"])
