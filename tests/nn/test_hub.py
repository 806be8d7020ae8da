"""Fetching the published checkpoint from a server on this machine: what arrives, what is refused, what stays behind."""

import hashlib
import http.server
import io
import re
import socket
import threading
from types import SimpleNamespace

import pytest
import torch

from reli3d.cli import infer
from reli3d.nn import hub
from reli3d.nn.model import Reconstructor
from reli3d.nn.published import KEY_MAP
from reli3d.nn.weights import WeightsError, load, official_path
from tests.support.evil import Bomb
from tests.support.networks import TINY

PATH = f"/{hub.REPOSITORY}/resolve/main/{hub.CHECKPOINT}"


class Hub(http.server.ThreadingHTTPServer):
    """Answers as the hub does: the first address redirects to a store and tells size and hash."""

    def __init__(self):
        super().__init__(("127.0.0.1", 0), Answer)
        self.content, self.sha256, self.status = b"", None, 0
        self.linked = self.ranges = True
        self.cut = None  # bytes after which each body breaks off
        self.requests: list[tuple[str, str, dict[str, str]]] = []

    @property
    def address(self) -> str:
        return f"http://127.0.0.1:{self.server_port}"


class Answer(http.server.BaseHTTPRequestHandler):
    def log_message(self, *_):
        pass

    def do_HEAD(self):
        self.do_GET()

    def do_GET(self):
        this = self.server
        this.requests.append((self.command, self.path, {k.lower(): v for k, v in self.headers.items()}))
        if this.status:
            self.reply(this.status, {"Content-Length": "0"})
            return
        content = this.content
        if self.path == PATH and this.linked:
            digest = this.sha256 or hashlib.sha256(content).hexdigest()
            # another name of this machine: another origin, to which no token may go
            store = f"http://localhost:{this.server_port}/store"
            self.reply(
                302,
                {
                    "Location": store,
                    "X-Linked-Size": str(len(content)),
                    "X-Linked-ETag": f'"{digest}"',
                    "Content-Length": "0",
                },
            )
            return
        start, status, headers = 0, 200, {}
        asked = self.headers.get("Range")
        if asked and this.ranges:
            start, status = int(re.fullmatch(r"bytes=(\d+)-", asked)[1]), 206
            headers["Content-Range"] = f"bytes {start}-{len(content) - 1}/{len(content)}"
        self.reply(status, headers | {"Content-Length": str(len(content) - start)})
        if self.command == "GET":
            self.wfile.write(content[start:][: this.cut])

    def reply(self, status: int, headers: dict[str, str]):
        self.send_response(status)
        for item in headers.items():
            self.send_header(*item)
        self.end_headers()


@pytest.fixture
def server(tmp_path, monkeypatch):
    server = Hub()
    threading.Thread(target=server.serve_forever, args=(0.01,), daemon=True).start()
    monkeypatch.setenv("HF_ENDPOINT", server.address)
    monkeypatch.setenv("NO_PROXY", "127.0.0.1,localhost")
    monkeypatch.setenv("RELI3D_WEIGHTS", str(tmp_path / "cache"))
    monkeypatch.delenv("HF_TOKEN", raising=False)
    monkeypatch.delenv("HF_HUB_OFFLINE", raising=False)
    monkeypatch.setattr(hub, "WAIT", 0.0)
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
    assert "\n" not in str(caught.value)


def test_the_checkpoint_arrives_converted_with_its_licence_and_nothing_beside(server, checkpoint, capsys, monkeypatch):
    server.content, state = checkpoint
    monkeypatch.setenv("HF_TOKEN", "hf_secret")
    path = hub.fetch_official(preset=TINY)
    assert left() == ["official.safetensors"]
    model, manifest = load(path)
    assert manifest.licence.startswith("Stability AI Community License")
    assert all(torch.equal(value, state[name]) for name, value in model.state_dict().items())
    assert capsys.readouterr().err.count("Stability AI Community License") == 1
    by_path = {path: headers for _, path, headers in server.requests}
    assert by_path[PATH]["authorization"] == "Bearer hf_secret" and "authorization" not in by_path["/store"]
    server.requests.clear()
    assert hub.fetch_official(preset=TINY) == path and server.requests == []  # it is there: no network


def test_a_broken_transfer_is_gone_on_with(server, checkpoint):
    server.content, server.cut = checkpoint[0], len(checkpoint[0]) // 3 + 1
    hub.fetch_official(preset=TINY)
    starts = [headers.get("range") for command, path, headers in server.requests if path == "/store"]
    assert starts == [None, f"bytes={server.cut}-", f"bytes={2 * server.cut}-"] and left() == ["official.safetensors"]


def test_the_next_call_goes_on_where_the_last_one_ended(server, checkpoint):
    server.content, server.cut = checkpoint[0], 0
    digest = hashlib.sha256(server.content).hexdigest()
    part = official_path().parent / f"{hub.CHECKPOINT}.{digest[:16]}.part"
    part.parent.mkdir(parents=True)
    part.write_bytes(server.content[:1000])
    fails(f"ended after 1000 of {len(server.content)} bytes.*run it again")
    assert left() == [part.name] and part.read_bytes() == server.content[:1000]  # a true beginning stays
    server.cut = None
    hub.fetch_official(preset=TINY)
    assert server.requests[-1][2]["range"] == "bytes=1000-" and left() == ["official.safetensors"]


def test_a_server_without_ranges_or_hash_starts_again(server, checkpoint):
    server.content, server.linked, server.ranges = checkpoint[0], False, False
    server.cut = len(server.content) - 1
    fails("ended after")
    assert left() == []  # without a hash nobody could tell what it is the beginning of
    server.cut = None
    hub.fetch_official(preset=TINY)
    assert left() == ["official.safetensors"]


def test_wrong_bytes_are_thrown_away(server, checkpoint):
    server.content, server.sha256 = checkpoint[0], "0" * 64
    fails("expected SHA-256 0{64}, got [0-9a-f]{64}")
    assert left() == []


@pytest.mark.parametrize(
    "status, message",
    [
        (401, "asks for a token .401.; accept the licence at http.*/StabilityLabs/ReLi3D and set HF_TOKEN"),
        (403, "asks for a token .403."),
        (404, "no such file .404."),
        (407, "proxy"),
        (429, "wait"),
        (503, "answered 503"),
        (301, "redirects more than 5 times|redirects to"),
    ],
)
def test_refusals_are_one_line_and_no_file(server, status, message):
    server.status = status
    fails(message)
    assert left() == []


def test_a_refused_token_is_not_shown(server, monkeypatch):
    server.status = 403
    monkeypatch.setenv("HF_TOKEN", "hf_secret")
    with pytest.raises(WeightsError, match="does not accept the token of HF_TOKEN") as caught:
        hub.fetch_official(preset=TINY)
    assert "secret" not in str(caught.value)
    monkeypatch.setenv("HF_TOKEN", "two\nlines")
    fails("HF_TOKEN: expected a token of printable characters")


def test_no_answer_no_server_and_a_dead_proxy_are_one_line(server, monkeypatch):
    with socket.create_server(("127.0.0.1", 0)) as silent:  # accepts and says nothing
        monkeypatch.setenv("HF_ENDPOINT", f"http://127.0.0.1:{silent.getsockname()[1]}")
        monkeypatch.setattr(hub, "TIMEOUT", 0.2)
        fails("no answer within 0.2 s")
        closed = silent.getsockname()[1]
    monkeypatch.setattr(hub, "TIMEOUT", 5.0)
    monkeypatch.setenv("HF_ENDPOINT", f"http://127.0.0.1:{closed}")
    fails("cannot be fetched .*refused")
    monkeypatch.setenv("HF_ENDPOINT", "https://hub.invalid")
    server.status = 407
    monkeypatch.setenv("HTTPS_PROXY", server.address)  # answers CONNECT with 501
    fails("Tunnel connection failed.*check HTTPS_PROXY")
    monkeypatch.setenv("HF_ENDPOINT", "file:///etc")
    fails("HF_ENDPOINT: expected an address with http or https")
    assert left() == []


def test_a_redirect_to_a_file_is_not_followed(server, monkeypatch, tmp_path):
    monkeypatch.setattr(Answer, "do_GET", lambda self: self.reply(302, {"Location": f"file://{tmp_path}/x"}))
    fails("redirects to file, which is not followed")


def test_offline_is_kept(server, checkpoint, monkeypatch):
    server.content = checkpoint[0]
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    fails("HF_HUB_OFFLINE forbids")
    assert server.requests == [] and left() == []


def test_a_pickle_bomb_does_not_go_off_and_does_not_stay(server, tmp_path):
    crater = tmp_path / "crater"
    bomb = tmp_path / "bomb.ckpt"
    torch.save({"state_dict": {"system.x": torch.ones(1)}, "hook": Bomb(crater)}, bomb)
    server.content = bomb.read_bytes()
    fails("refused, nothing was run")
    assert not crater.exists() and left() == []


def test_a_checkpoint_put_there_by_hand_needs_no_network_and_stays(server, checkpoint, monkeypatch):
    official_path().parent.mkdir(parents=True)
    official_path().with_name(hub.CHECKPOINT).write_bytes(checkpoint[0])
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    hub.fetch_official(preset=TINY)
    assert left() == ["official.safetensors", hub.CHECKPOINT] and server.requests == []


def test_a_full_disk_is_named_before_anything_is_fetched(server, checkpoint, monkeypatch):
    server.content = checkpoint[0]
    monkeypatch.setattr(hub.shutil, "disk_usage", lambda folder: SimpleNamespace(free=0))
    fails("expected 0.0 GB of free space, got 0.0; set RELI3D_WEIGHTS")
    assert left() == []


def test_two_at_a_time_do_not_mix(server, checkpoint):
    fcntl = pytest.importorskip("fcntl")
    server.content = checkpoint[0]
    part = official_path().parent / f"{hub.CHECKPOINT}.{hashlib.sha256(server.content).hexdigest()[:16]}.part"
    part.parent.mkdir(parents=True)
    with open(part, "wb") as other:
        fcntl.flock(other, fcntl.LOCK_EX)
        fails("another process is fetching it")
    assert left() == [part.name]


def run(tmp_path, *arguments) -> int:
    return infer.main([str(infer.EXAMPLE), "--output", str(tmp_path / "out"), "--device", "cpu", *arguments])


def test_the_command_asks_no_network_without_download(server, tmp_path, capsys, monkeypatch):
    fail = lambda device, names: pytest.fail("compiled before weights were looked for")  # noqa: E731
    monkeypatch.setattr(infer, "ready_kernels", fail)
    assert run(tmp_path, "--weights", "official") == 2
    out, err = capsys.readouterr()
    assert out == "" and err.count("\n") == 1 and "fetch them with --download" in err
    assert server.requests == [] and not (tmp_path / "out").exists() and left() == []


def test_the_command_ends_with_2_and_one_line_where_fetching_fails(server, checkpoint, tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(hub.fetch_official.__kwdefaults__, "preset", TINY)
    crater, content = tmp_path / "crater", checkpoint[0]
    lacking = torch.load(io.BytesIO(content), weights_only=True)
    lacking["state_dict"].pop("system.backbone.latent_init")

    def saved(value) -> bytes:
        torch.save(value, buffer := io.BytesIO())
        return buffer.getvalue()

    def ended(message: str) -> None:
        assert run(tmp_path, "--weights", "official", "--download") == 2
        err = capsys.readouterr().err
        lines = [line for line in err.split("\n") if line.startswith("reli3d-infer: ")]
        assert len(lines) == 1 and re.search(message, lines[0]), (err, message)
        assert left() == [] and not (tmp_path / "out").exists()

    for edit, message in [
        (dict(status=401), "accept the licence"),
        (dict(status=0, content=b"not a pickle"), "is not a torch checkpoint"),
        (dict(content=content[: len(content) // 2]), "is not a torch checkpoint, or it is cut off"),
        (dict(content=saved({"state_dict": {}, "hook": Bomb(crater)})), "refused, nothing was run"),
        (dict(content=saved(lacking)), "lacks 1 of .* tensors, first backbone.latent_init"),
        (dict(content=content, sha256="f" * 64), "expected SHA-256 f{64}, got [0-9a-f]{64}"),
        (dict(sha256=None, linked=False, ranges=False, cut=1000), "ended after 1000 of"),
    ]:
        vars(server).update(edit)
        ended(message)
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    ended("HF_HUB_OFFLINE forbids")
    monkeypatch.delenv("HF_HUB_OFFLINE")
    server.shutdown()
    server.socket.close()
    ended("cannot be fetched .*; check the network")
    assert not crater.exists()
    assert run(tmp_path, "--weights", "small", "--download") == 2
    assert "download: expected --weights official" in capsys.readouterr().err


def test_the_command_ends_with_2_where_the_converted_file_is_cut_off(server, checkpoint, tmp_path, capsys):
    server.content = checkpoint[0]
    path = hub.fetch_official(preset=TINY)
    path.write_bytes(path.read_bytes()[:-100])
    capsys.readouterr()
    assert run(tmp_path, "--weights", "official") == 2
    out, err = capsys.readouterr()
    assert out == "" and err.count("\n") == 1 and "official.safetensors: expected" in err and "fetch it again" in err
    assert left() == [path.name] and not (tmp_path / "out").exists()
