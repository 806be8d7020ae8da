"""Files of weights: every published tensor has its place, and a bad file is one line and leaves nothing behind."""

import json
import os
import pickle
from collections import Counter
from pathlib import Path

import pytest
import torch
from safetensors import safe_open

from reli3d.nn import weights
from reli3d.nn.model import Reconstructor
from reli3d.nn.presets import OFFICIAL, SMALL
from reli3d.nn.published import UNUSED, our_key
from reli3d.nn.weights import WeightsError, convert_checkpoint, known_sha256, load, load_model, save, sha256, write
from tests.support.hostile import Bomb
from tests.support.networks import NANO, TINY, views

LICENSE = "Apache-2.0"


@pytest.fixture
def published(goldens):
    """``{name: shape}`` of the published checkpoint."""
    listed = json.loads((goldens.parent / "official_state_dict.json").read_text())
    return {name: tuple(entry[0]) for name, entry in listed.items() if name != "_summary"}


def test_every_published_tensor_has_one_place_and_none_is_left(published):
    ours = weights.shapes(OFFICIAL)
    assert len(published) == 1774
    published = {name: shape for name, shape in published.items() if not name.startswith(UNUSED)}
    places = {name: our_key(name) for name in published}
    assert {name for name, place in places.items() if place not in ours} == set()
    assert set(ours) - set(places.values()) == set()
    assert {name for name, place in places.items() if ours[place] != published[name]} == set()
    twice = Counter(places.values())
    assert sum(count - 1 for count in twice.values()) == 144 and max(twice.values()) == 2
    numbers = sum(torch.Size(shape).numel() for shape in ours.values())
    # parameters of the listing without the ten of tone mapping, and the two unused mask tokens
    assert numbers == 1_574_452_729 - 10 + 1024 + 384


@pytest.fixture
def checkpoint(published, tmp_path):
    """A tiny network as a checkpoint in the published form, aliases included, and the network."""
    torch.manual_seed(0)
    model = Reconstructor(TINY).eval()
    for p in model.parameters():  # modulations start at zero, which would hide a mix-up
        torch.nn.init.normal_(p, std=0.05)
    path, ours = tmp_path / "published.ckpt", model.state_dict()
    state = {"system." + name: ours[our_key(name)] for name in published if our_key(name) in ours}
    torch.save({"epoch": 3, "state_dict": state | {"loss.weight": torch.ones(2)}}, path)
    return path, model


@torch.no_grad()
def test_a_published_checkpoint_converts_and_loads_strictly(checkpoint, tmp_path):
    path, model = checkpoint
    target = tmp_path / "converted.safetensors"
    manifest = convert_checkpoint(path, target, license="of the model's authors", preset=TINY)
    assert manifest.license == "of the model's authors" and manifest.metadata["converted_from"] == sha256(path)
    loaded, _ = load(target, expected_sha256=sha256(target))
    assert loaded.preset == TINY and not loaded.training
    for name, value in model.state_dict().items():
        torch.testing.assert_close(loaded.state_dict()[name], value, rtol=0, atol=0)
    inputs = views(1, 2, 76)
    torch.testing.assert_close(loaded.encode(*inputs).triplane, model.encode(*inputs).triplane, rtol=0, atol=0)


LATENT, ALIAS = "system.backbone.latent_init", "system.tokenizer.0.modulations.0.linear2.weight"


@pytest.mark.parametrize(
    "edit, message",
    [
        (lambda s: s.pop(LATENT), "lacks 1 of .* tensors, first backbone.latent_init"),
        (lambda s: s.update({"system.extra": torch.ones(1)}), "extra: not a tensor of the published model"),
        (lambda s: s.update({LATENT: torch.ones(1, 9, 32)}), r"init: expected shape \(1, 10, 32\), got \(1, 9, 32\)"),
        (lambda s: s.update({ALIAS: s[ALIAS] + 1}), "expected the values of the same parameter's other name"),
        (lambda s: s.update({LATENT: torch.ones(1, 10, 32).int()}), "expected floating-point"),
        (lambda s: s.clear(), "lacks .* tensors"),
    ],
)
def test_a_wrong_checkpoint_is_one_line_and_no_file(checkpoint, tmp_path, edit, message):
    path, _ = checkpoint
    content = torch.load(path, weights_only=True)
    edit(content["state_dict"])
    torch.save(content, path)
    refused(path, tmp_path, message)


def refused(path, folder, message):
    before = set(folder.iterdir())
    with pytest.raises(WeightsError, match=message) as caught:
        convert_checkpoint(path, folder / "out.safetensors", license=LICENSE, preset=TINY)
    assert "\n" not in str(caught.value) and str(path) in str(caught.value)
    assert set(folder.iterdir()) == before


def test_a_pickle_that_runs_code_is_refused_and_does_not_run(tmp_path):
    (tmp_path / "files").mkdir()
    crater = tmp_path / "crater"
    zipped, unlit = tmp_path / "files" / "bomb.ckpt", tmp_path / "files" / "plain.ckpt"
    torch.save({"state_dict": {"system.x": torch.ones(1)}, "hook": Bomb(crater)}, zipped)
    unlit.write_bytes(pickle.dumps(Bomb(crater)))
    refused(zipped, tmp_path / "files", "rejected, nothing was run")
    refused(unlit, tmp_path / "files", "is not a torch checkpoint|rejected, nothing was run")
    assert not crater.exists()


def test_a_checkpoint_that_is_cut_off_empty_or_absent(checkpoint, tmp_path):
    path, _ = checkpoint
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])
    refused(path, tmp_path, "is not a torch checkpoint, or it is cut off")
    path.write_bytes(b"")
    refused(path, tmp_path, "is not a torch checkpoint, or it is cut off")
    path.unlink()
    refused(path, tmp_path, "file not found")
    torch.save(torch.ones(3), path)
    refused(path, tmp_path, "expected tensors under state_dict")


@pytest.fixture
def saved(tmp_path):
    torch.manual_seed(0)
    model = Reconstructor(NANO).eval()
    path = tmp_path / "nano.safetensors"
    save(path, model, license=LICENSE, metadata={"steps": "12"})
    return path, model


@torch.no_grad()
def test_saved_weights_carry_their_preset_and_license(saved):
    path, model = saved
    with pytest.raises(WeightsError, match="tensors"):
        load(path, TINY)
    loaded, manifest = load(path)
    assert loaded.preset == NANO and manifest.license == LICENSE and manifest.metadata["steps"] == "12"
    assert all(p.dtype == torch.float32 and p.requires_grad for p in loaded.parameters())
    assert manifest.tensors["environment.sample_directions"].dtype == torch.float32  # float16 would bend the map
    inputs = views(1, 2, 32)
    expected = model.encode(*inputs).triplane
    # float16 keeps 11 bits of each weight; the outputs' error is of that order
    assert (loaded.encode(*inputs).triplane - expected).norm() < 2e-3 * expected.norm()
    low, _ = load(path, trunk=torch.bfloat16)
    assert low.backbone.latent_init.dtype == torch.bfloat16 and low.heads["density"][0].weight.dtype == torch.float32
    with safe_open(path, "pt") as file:  # the reference reader agrees with our writer
        assert set(file.keys()) == set(model.state_dict())
        torch.testing.assert_close(file.get_tensor("backbone.latent_init"), model.backbone.latent_init.half())


@pytest.mark.skipif(not Path("/proc/self/maps").exists(), reason="needs the system's list of mapped files")
def test_tensors_of_the_stored_dtype_are_mapped_and_not_copied(saved, tmp_path):
    _, model = saved
    path = tmp_path / "single.safetensors"
    save(path, model, license=LICENSE, dtype=torch.float32)
    loaded, _ = load(path)
    lines = [line.split()[0] for line in Path("/proc/self/maps").read_text().splitlines() if line.endswith(str(path))]
    ranges = [tuple(int(end, 16) for end in line.split("-")) for line in lines]
    assert all(any(a <= p.data_ptr() < b for a, b in ranges) for p in loaded.parameters())


def test_a_failed_save_leaves_the_old_file(saved):
    path, model = saved
    before = path.read_bytes()
    model.backbone.latent_init.data[0, 0, 0] = 1e6  # beyond float16
    with pytest.raises(WeightsError, match="backbone.latent_init: expected finite values"):
        save(path, model, license=LICENSE)
    assert path.read_bytes() == before and len(list(path.parent.iterdir())) == 1


def header(edit):
    def spoil(path):
        data = path.read_bytes()
        end = 8 + int.from_bytes(data[:8], "little")
        content = json.loads(data[8:end])
        edit(content)
        text = json.dumps(content).encode()
        path.write_bytes(len(text).to_bytes(8, "little") + text + data[end:])

    return spoil


@pytest.mark.parametrize(
    "spoil, message",
    [
        (lambda p: p.write_bytes(p.read_bytes()[:-1]), "is not a safetensors file, or it is cut off"),
        (lambda p: p.write_bytes(p.read_bytes() + b"0"), "is not a safetensors file, or it is cut off"),
        (lambda p: p.write_bytes(p.read_bytes()[:100]), "is not a safetensors file, or it is cut off"),
        (lambda p: p.write_bytes(b"\xff" * 64), "is not a safetensors file"),
        (lambda p: p.write_bytes(b""), "is not a safetensors file"),
        (lambda p: torch.save({"state_dict": {}}, p), "is a torch checkpoint, expected safetensors; convert it first"),
        (lambda p: p.write_bytes((2).to_bytes(8, "little") + b"[]"), "is not a safetensors file"),
        (header(lambda h: h["backbone.latent_init"].update(shape=[1, 8, 31])), "is not a safetensors file"),
        (header(lambda h: h["backbone.latent_init"].update(dtype="I16")), "latent_init: expected floating-point"),
        (header(lambda h: h["backbone.latent_init"].update(shape=[1 << 40] * 2)), "is not a safetensors file"),
        (header(lambda h: h["__metadata__"].pop("preset")), "has no preset in its header"),
        (header(lambda h: h["__metadata__"].update(preset="{}")), "preset.backbone: expected a value, got none"),
        (header(lambda h: h.update({"other": h.pop("backbone.latent_init")})), "lacks 1 of"),
        (lambda p: p.unlink(), "file not found"),
    ],
)
def test_a_spoilt_file_is_one_line(saved, spoil, message):
    path, _ = saved
    spoil(path)
    with pytest.raises(WeightsError, match=message) as caught:
        load(path)
    assert "\n" not in str(caught.value) and "nano.safetensors" in str(caught.value)


def test_names_and_paths_find_their_file(saved, monkeypatch):
    path, _ = saved
    assert load_model(path).preset == NANO and load_model(str(path)).preset == NANO
    monkeypatch.setenv("RELI3D_WEIGHTS", str(path.parent))
    with pytest.raises(WeightsError, match="official.safetensors: no such file of weights; fetch them with reli3d"):
        load_model("official")
    path.rename(path.with_name("official.safetensors"))
    assert load_model("official").preset == NANO
    with pytest.raises(WeightsError, match="gone: no such file of weights; check the path"):
        load_model(path.parent / "gone")


def test_a_large_file_is_hashed_once_and_a_check_always(saved, monkeypatch):
    path, _ = saved
    note, digest, hashed = path.with_name(path.name + ".sha256"), sha256(path), []
    monkeypatch.setattr(weights, "sha256", lambda p: hashed.append(p) or sha256(p))
    assert known_sha256(path) == digest and not note.exists()  # a small one leaves nothing
    monkeypatch.setattr(weights, "LARGE", 1)
    assert known_sha256(path) == known_sha256(path) == digest and len(hashed) == 2
    note.write_text(note.read_text().replace(digest, "0" * 64))
    assert known_sha256(path) == "0" * 64  # it is the note that is read, and so no check:
    with pytest.raises(WeightsError, match=f"expected SHA-256 0{{64}}, got {digest}"):
        load(path, expected_sha256="0" * 64)
    path.write_bytes(path.read_bytes())  # another time of change
    os.utime(path, ns=(1, 1))
    assert known_sha256(path) == digest
    note.write_text("spoilt")
    assert known_sha256(path) == digest and len(hashed) == 5
    monkeypatch.setattr(weights, "replacing", lambda p: (_ for _ in ()).throw(PermissionError("read-only folder")))
    note.unlink()
    assert known_sha256(path) == digest and not note.exists()


def test_bfloat16_is_the_default_for_the_published_sizes_on_cuda_alone(saved):
    assert weights.default_trunk(OFFICIAL, "cuda") == torch.bfloat16
    others = ((OFFICIAL, "cpu"), (SMALL, "cpu"), (SMALL, "cuda"))
    assert {weights.default_trunk(preset, device) for preset, device in others} == {torch.float32}
    path, _ = saved
    assert load_model(path).dtype == torch.float32 and load_model(path, trunk=torch.bfloat16).dtype == torch.bfloat16


def test_written_files_hold_bfloat16_and_scalars(tmp_path):
    path = tmp_path / "x.safetensors"
    state = {"b": torch.arange(6.0).reshape(2, 3).bfloat16(), "a": torch.tensor(2.5), "c": torch.zeros(0, 4)}
    write(path, state, {})
    assert weights.read_manifest(path).tensors["b"].shape == (2, 3)
    with safe_open(path, "pt") as file:
        for name, value in state.items():
            torch.testing.assert_close(file.get_tensor(name), value, rtol=0, atol=0)


@pytest.mark.parametrize("instruction", ["avx512_bf16", "amx_bf16", "bf16", "avx512_f", None])
def test_automatic_precision_is_bfloat16_where_the_processor_multiplies_it(tmp_path, monkeypatch, instruction):
    instructions = {"avx512_bf16": False, instruction: True} if instruction else {}
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: instructions, raising=False)
    expected = torch.bfloat16 if "bf16" in (instruction or "") else torch.float32
    save(tmp_path / "nano.safetensors", Reconstructor(NANO), license="none")
    assert load_model(tmp_path / "nano.safetensors", trunk="auto").dtype == expected
    assert load_model("small", trunk="auto").dtype == expected
