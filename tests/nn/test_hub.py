"""Fetching the published checkpoint from a hub on this machine: results, refusals, leftovers."""

import errno
import hashlib
import http.server
import os
import re
import sys
import threading

import pytest
import torch

from reli3d.cli import download, infer
from reli3d.nn import hub
from reli3d.nn.model import Reconstructor
from reli3d.nn.published import KEY_MAP
from reli3d.nn.weights import WeightsError, load, official_path
from tests.support.networks import TINY

huggingface_hub = pytest.importorskip("huggingface_hub")
constants = pytest.importorskip("huggingface_hub.constants")
PATH = f"/{hub.REPOSITORY}/resolve/main/{hub.CHECKPOINT}"


class Hub(http.server.ThreadingHTTPServer):
    """Answers as the hub does: the first address states size and hash and redirects to a store."""

    def __init__(self):
        super().__init__(("127.0.0.1", 0), Answer)
        self.content, self.sha256, self.status, self.code = b"", None, 0, ""
        self.cuts = []  # bytes after which the next bodies break off
        self.requests: list[tuple[str, str, dict[str, str]]] = []


class Answer(http.server.BaseHTTPRequestHandler):
    def log_message(self, *_):
        pass

    def do_HEAD(self):
        self.do_GET()

    def do_GET(self):
        this = self.server
        this.requests.append((self.command, self.path, {k.lower(): v for k, v in self.headers.items()}))
        content = this.content
        if this.status:
            self.reply(this.status, {"Content-Length": "0", "X-Error-Code": this.code})
        elif self.path == PATH:
            digest = this.sha256 or hashlib.sha256(content).hexdigest()
            # another name of this machine: another origin, to which no token may go
            store = f"http://localhost:{this.server_port}/store"
            linked = {"X-Linked-Size": str(len(content)), "X-Linked-ETag": f'"{digest}"', "X-Repo-Commit": "a" * 40}
            self.reply(302, {"Location": store, **linked, "Content-Length": "0"})
        else:
            start, status, headers = 0, 200, {}
            if found := re.match(r"bytes=(\d+)-", self.headers.get("Range") or ""):
                start, status = int(found[1]), 206
                headers["Content-Range"] = f"bytes {start}-{len(content) - 1}/{len(content)}"
            self.reply(status, headers | {"Content-Length": str(len(content) - start)})
            if self.command == "GET":
                self.wfile.write(content[start:][: this.cuts.pop(0) if this.cuts else None])

    def reply(self, status: int, headers: dict[str, str]):
        self.send_response(status)
        for item in headers.items():
            self.send_header(*item)
        self.end_headers()


@pytest.fixture
def server(tmp_path, monkeypatch):
    server = Hub()
    threading.Thread(target=server.serve_forever, args=(0.01,), daemon=True).start()
    monkeypatch.setenv("HF_ENDPOINT", f"http://127.0.0.1:{server.server_port}")
    monkeypatch.setenv("HF_HOME", str(tmp_path / "huggingface"))
    monkeypatch.setenv("NO_PROXY", "127.0.0.1,localhost")
    monkeypatch.setenv("RELI3D_WEIGHTS", str(tmp_path / "cache"))
    monkeypatch.delenv("HF_TOKEN", raising=False)
    yield server
    server.shutdown()
    server.server_close()


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory):
    """A tiny network in the published form, as bytes, and its parameters by our names."""
    torch.manual_seed(0)
    state = Reconstructor(TINY).state_dict()
    published = {}
    for name, value in state.items():
        theirs = next(t + name[len(o) :] for t, o in KEY_MAP if name.startswith(o))
        published["system." + theirs] = value
    path = tmp_path_factory.mktemp("checkpoint") / "published.ckpt"
    torch.save({"state_dict": published}, path)
    return path.read_bytes(), state


def left() -> list[str]:
    folder = official_path().parent
    return sorted(p.name for p in folder.iterdir()) if folder.exists() else []


def fails(message: str) -> None:
    with pytest.raises(WeightsError, match=message) as caught:
        hub.fetch_official(preset=TINY)
    assert "\n" not in str(caught.value) and "secret" not in str(caught.value)


def test_the_checkpoint_arrives_converted_with_its_license_and_nothing_else(server, checkpoint, capsys, monkeypatch):
    server.content, state = checkpoint
    monkeypatch.setenv("HF_TOKEN", "hf_secret")
    path = hub.fetch_official(preset=TINY)
    assert left() == ["official.safetensors"]
    model, manifest = load(path)
    assert manifest.license.startswith("Stability AI Community License")
    assert all(torch.equal(value, state[name]) for name, value in model.state_dict().items())
    assert capsys.readouterr().err.count("Stability AI Community License") == 1
    by_path = {path: headers for _, path, headers in server.requests}
    assert by_path[PATH]["authorization"] == "Bearer hf_secret" and "authorization" not in by_path["/store"]
    server.requests.clear()
    assert hub.fetch_official(preset=TINY) == path and server.requests == []  # it is there: no network


def test_a_transfer_that_breaks_off_is_resumed_and_wrong_bytes_are_refused(server, checkpoint, monkeypatch):
    monkeypatch.setattr(constants, "DOWNLOAD_CHUNK_SIZE", 1 << 20)  # or the tiny checkpoint is a single one
    server.content, server.cuts = checkpoint[0], [(1 << 20) + 1000]
    hub.fetch_official(preset=TINY)
    starts = [headers.get("range", "") for command, _, headers in server.requests if command == "GET"]
    assert len(starts) == 2 and starts[1].startswith(f"bytes={1 << 20}-") and left() == ["official.safetensors"]
    official_path().unlink()
    server.sha256 = "0" * 64
    fails("expected SHA-256 0{64}, got [0-9a-f]{64}")
    assert left() == []


@pytest.mark.parametrize(
    "status, code, message",
    [
        (401, "", "access refused .401.: accept the license at http.*/StabilityLabs/ReLi3D and set HF_TOKEN"),
        (403, "GatedRepo", "access refused .403."),
        (404, "EntryNotFound", "no such file .404.; check HF_ENDPOINT"),
        (404, "RepoNotFound", "no such file .404."),
        (400, "", "cannot be fetched .*400"),
    ],
)
def test_refusals_are_one_line_and_no_file(server, monkeypatch, status, code, message):
    monkeypatch.setenv("HF_TOKEN", "hf_secret")
    server.status, server.code = status, code
    fails(message)
    assert left() == []


def test_no_extra_no_network_and_no_space_are_one_line(server, checkpoint, monkeypatch):
    server.content = checkpoint[0]
    with monkeypatch.context() as patch:
        patch.setattr(constants, "HF_HUB_OFFLINE", True)
        fails(f"HF_HUB_OFFLINE forbids the download; unset it, or put the file into {official_path().parent}")
        assert server.requests == []
    with monkeypatch.context() as patch:
        full = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        patch.setattr(huggingface_hub, "hf_hub_download", lambda *_, **__: (_ for _ in ()).throw(full))
        fails("no space left in .*: set RELI3D_WEIGHTS")
    with monkeypatch.context() as patch:
        patch.setitem(sys.modules, "huggingface_hub", None)
        fails(r"reli3d download needs huggingface_hub: pip install 'reli3d\[hub\]'")
    assert left() == []


def test_a_manually_copied_checkpoint_needs_no_network_and_stays(server, checkpoint):
    official_path().parent.mkdir(parents=True)
    official_path().with_name(hub.CHECKPOINT).write_bytes(checkpoint[0])
    hub.fetch_official(preset=TINY)
    assert left() == ["official.safetensors", hub.CHECKPOINT] and server.requests == []


def test_only_the_command_download_uses_the_network(server, checkpoint, tmp_path, capsys):
    server.content = checkpoint[0][:-1]  # of the size that the hub states, but no checkpoint

    def ended(code: int) -> str:
        out, err = capsys.readouterr()
        (line,) = [line for line in err.split("\n") if line.startswith(("reli3d-infer: ", "reli3d download: "))]
        assert code == 2 and out == "" and not (tmp_path / "out").exists()
        return line

    options = ["--output", str(tmp_path / "out"), "--device", "cpu", "--weights", "official"]
    assert "fetch them with reli3d download" in ended(infer.main([str(infer.EXAMPLE), *options]))
    assert server.requests == []
    assert "is not a torch checkpoint, or it is cut off" in ended(download.main([])) and left() == []
    assert any(path == "/store" for _, path, _ in server.requests)
