"""Headless Chromium by its debugging pipe: opens pages, evaluates JavaScript and captures images.

Chromium is ``RELI3D_CHROMIUM`` or the first of chromium, chromium-browser and google-chrome on the path.  WebGL is
drawn by its software renderer, so no GPU is needed.
"""

from __future__ import annotations

import base64
import contextlib
import functools
import http.server
import io
import json
import os
import select
import shutil
import subprocess
import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

FLAGS = (
    "--headless=new",
    "--no-sandbox",
    "--disable-gpu",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--hide-scrollbars",
    "--force-device-scale-factor=1",
    "--remote-debugging-pipe",
)
TIMEOUT = 240.0  # seconds; the software renderer needs some for a page on a busy machine


def find_chromium() -> str:
    """Path of Chromium; the calling test is skipped visibly where there is none."""
    named = os.environ.get("RELI3D_CHROMIUM")
    found = named or next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    if found is None:
        pytest.skip("needs Chromium: apt-get install chromium, or RELI3D_CHROMIUM")
    return found


class Page:
    """One page; ``problems`` gathers errors and warnings of its console, and exceptions."""

    def __init__(self, process: subprocess.Popen, read: int, write: int):
        self._process, self._read, self._write = process, read, write
        self._buffer, self._next, self._session = b"", 0, None
        self.problems: list[str] = []
        target = self._call("Target.createTarget", url="about:blank")["targetId"]
        self._session = self._call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        for domain in ("Page", "Runtime", "Log"):
            self._call(f"{domain}.enable")

    def open(self, url: str, *, size: tuple[int, int] = (512, 512)) -> Page:
        """Go to ``url`` with a window of ``size`` pixels; returns once the document is there."""
        self._call(
            "Emulation.setDeviceMetricsOverride", width=size[0], height=size[1], deviceScaleFactor=1, mobile=False
        )
        self._call("Page.navigate", url=url)
        self.wait("document.readyState === 'complete' && location.href !== 'about:blank'")
        return self

    def evaluate(self, code: str):
        """Value of the JavaScript expression ``code``; a promise is awaited.  Its exception fails the test."""
        result = self._call("Runtime.evaluate", expression=code, awaitPromise=True, returnByValue=True)
        if "exceptionDetails" in result:
            raise AssertionError(result["exceptionDetails"].get("exception", {}).get("description", str(result)))
        return result["result"].get("value")

    def wait(self, code: str) -> None:
        """Return once ``code`` is true."""
        end = time.monotonic() + TIMEOUT
        while not self.evaluate(f"Boolean({code})"):
            if time.monotonic() > end:
                raise AssertionError(f"{code}: not true after {TIMEOUT:g} s; problems {self.problems}")
            time.sleep(0.1)

    def screenshot(self) -> np.ndarray:
        """The window's image, ``(H, W, 3)`` uint8."""
        return pixels(self._call("Page.captureScreenshot", format="png")["data"])[..., :3]

    def _call(self, method: str, **params) -> dict:
        self._next += 1
        message = {"id": self._next, "method": method, "params": params}
        if self._session:
            message["sessionId"] = self._session
        data = json.dumps(message).encode() + b"\0"
        while data:
            data = data[os.write(self._write, data) :]
        while True:
            got = self._receive(method)
            if got.get("id") == self._next:
                if "error" in got:
                    raise AssertionError(f"{method}: {got['error']['message']}")
                return got["result"]
            self._note(got.get("method"), got.get("params", {}))

    def _receive(self, method: str) -> dict:
        while b"\0" not in self._buffer:
            if not select.select([self._read], [], [], TIMEOUT)[0]:
                raise AssertionError(f"{method}: no answer from Chromium after {TIMEOUT:g} s")
            data = os.read(self._read, 1 << 20)
            if not data:
                raise AssertionError(f"{method}: Chromium ended with {self._process.wait(10)}")
            self._buffer += data
        line, self._buffer = self._buffer.split(b"\0", 1)
        return json.loads(line)

    def _note(self, event: str | None, params: dict) -> None:
        if event == "Runtime.exceptionThrown":
            self.problems.append(str(params["exceptionDetails"].get("exception", params["exceptionDetails"])))
        elif event == "Runtime.consoleAPICalled" and params["type"] in ("error", "warning", "assert"):
            self.problems.append(" ".join(str(a.get("value", a.get("description"))) for a in params["args"]))
        elif event == "Log.entryAdded" and params["entry"]["level"] in ("error", "warning"):
            if "GL Driver Message (OpenGL, Performance" in params["entry"]["text"]:
                return  # reading an image back waits for the software renderer
            self.problems.append(f"{params['entry']['text']} {params['entry'].get('url', '')}")


def pixels(data: str) -> np.ndarray:
    """``(H, W, 4)`` uint8 of a PNG in base64, also of a data URL."""
    return np.asarray(Image.open(io.BytesIO(base64.b64decode(data.rpartition(",")[2]))).convert("RGBA"))


@contextlib.contextmanager
def chromium() -> Iterator[Page]:
    """A page of a fresh browser, which ends with the block."""
    program = find_chromium()
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        to_browser, to_us = os.pipe(), os.pipe()
        high = [os.dup(fd) for fd in (to_browser[0], to_us[1])]

        def wire():  # Chromium reads from 3 and writes to 4; the copies lie above, so that neither overwrites the other
            os.dup2(high[0], 3)
            os.dup2(high[1], 4)

        process = subprocess.Popen(
            [program, *FLAGS, f"--user-data-dir={profile}"],
            preexec_fn=wire,
            pass_fds=(3, 4),
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        for fd in (to_browser[0], to_us[1], *high):
            os.close(fd)
        try:
            yield Page(process, to_us[0], to_browser[1])
        finally:
            os.close(to_browser[1])  # Chromium leaves when its pipe closes
            os.close(to_us[0])
            try:
                process.wait(20)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


@contextlib.contextmanager
def served(folder: Path) -> Iterator[str]:
    """``http://127.0.0.1:port`` of the files of ``folder``."""

    class Silent(http.server.SimpleHTTPRequestHandler):
        def log_message(self, *_):
            pass

    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(Silent, directory=str(folder))) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_port}"
        server.shutdown()
