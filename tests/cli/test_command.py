"""``reli3d``: every command by its name; ``reli3d view`` serves the page of a folder and nothing else."""

import functools
import http.client
import http.server
import re
import signal
import subprocess
import sys
import threading
import urllib.error
import urllib.request

import pytest

from reli3d.cli import doctor, main, view
from tests.support.processes import heed_signals


def test_help_names_every_command_and_the_old_names(capsys):
    assert main.main([]) == 0
    text = capsys.readouterr().out
    for name in ("infer", "view", "check", "render", "download", "data", "train", "tables", "doctor"):
        assert re.search(rf"^  {name} ", text, re.MULTILINE)
    for name in ("infer", "render", "data", "train", "tables"):
        assert f"reli3d-{name}" in text


@pytest.mark.parametrize("name", main.COMMANDS)
def test_every_command_has_its_help(name, capsys):
    with pytest.raises(SystemExit) as stop:
        main.main([name, "--help"])
    assert stop.value.code == 0 and "usage: reli3d" in capsys.readouterr().out


def test_options_reach_the_command_and_so_does_its_exit_code(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(doctor, "examine", lambda: ([("state", "ill")], False))
    assert main.main(["doctor"]) == 1 and capsys.readouterr().out.split() == ["state", "ill"]
    assert main.main(["view", str(tmp_path)]) == 2
    assert capsys.readouterr().err.startswith("reli3d view: ")
    assert main.main(["check", str(tmp_path), "--output", str(tmp_path)]) == 2  # not an object folder
    assert main.main(["infr"]) == 2
    assert "invalid choice: 'infr'" in capsys.readouterr().err


def test_view_serves_the_folder_on_this_machine_until_it_is_stopped(tmp_path):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / view.PAGE).write_text("the page")
    (tmp_path / "secret").write_text("not served")
    command = [sys.executable, "-m", "reli3d.cli.main", "view", str(tmp_path / "out"), "--no-browser"]

    pipe = subprocess.PIPE
    with subprocess.Popen(command, stdout=pipe, stderr=pipe, text=True, preexec_fn=heed_signals) as process:
        try:
            url = process.stdout.readline().strip()
            assert re.fullmatch(r"http://127\.0\.0\.1:\d+/viewer\.html", url)
            with urllib.request.urlopen(url, timeout=30) as answer:
                assert answer.read() == b"the page"
            with pytest.raises(urllib.error.HTTPError):
                urllib.request.urlopen(url.replace("viewer.html", "../secret"), timeout=30)
        finally:
            process.send_signal(signal.SIGINT)
            assert process.wait(30) == 0
        assert process.stderr.read() == ""


def test_view_answers_its_own_address_alone(tmp_path):
    """A page of another site whose name leads to 127.0.0.1 (DNS rebinding) sends that name as ``Host``."""
    (tmp_path / view.PAGE).write_text("the page")
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(view.Handler, directory=str(tmp_path)))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    port = server.server_port

    def status(*hosts: str) -> int:
        connection = http.client.HTTPConnection("127.0.0.1", port, timeout=30)
        connection.putrequest("GET", f"/{view.PAGE}", skip_host=True)
        for host in hosts:
            connection.putheader("Host", host)
        connection.endheaders()
        return connection.getresponse().status

    try:
        for name in ("localhost", "127.0.0.1", "[::1]"):
            assert status(f"{name}:{port}") == 200
        for host in (
            "hostile.example",
            f"hostile.example:{port}",
            "localhost",
            f"127.0.0.1:{port + 1}",
            f"127.0.0.1.x:{port}",
        ):
            assert status(host) == 403, host
        assert status() == 403 and status(f"localhost:{port}", "hostile.example") == 403
    finally:
        server.shutdown()
        server.server_close()


@pytest.mark.parametrize("arguments", [["none"], [".", "--port", "70000"]])
def test_view_refuses_in_one_line(tmp_path, monkeypatch, capsys, arguments):
    monkeypatch.chdir(tmp_path)
    (tmp_path / view.PAGE).touch()
    assert view.main(arguments) == 2
    output = capsys.readouterr()
    assert output.out == "" and output.err.startswith("reli3d view: ") and output.err.count("\n") == 1
    assert "expected" in output.err


def test_view_of_the_folder_above_names_the_one_below(tmp_path, capsys):
    (tmp_path / "shoe").mkdir()
    (tmp_path / "shoe" / view.PAGE).touch()
    assert view.main([str(tmp_path)]) == 2
    assert capsys.readouterr().err.rstrip().endswith(f"give {tmp_path / 'shoe'}")


def test_help_lists_defaults(capsys):
    for name in ("infer", "render", "data render", "data pack", "tables"):
        with pytest.raises(SystemExit):
            main.main([*name.split(), "--help"])
        text = " ".join(capsys.readouterr().out.split())
        assert "default" in text and "(default None)" not in text and "(default False)" not in text
