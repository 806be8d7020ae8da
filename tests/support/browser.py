"""Headless Chromium by Playwright: opens pages, evaluates JavaScript and captures images.

Chromium is ``RELI3D_CHROMIUM`` or the first of chromium, chromium-browser and google-chrome on the path.  WebGL is
drawn by its software renderer, so no GPU is needed.
"""

import base64
import contextlib
import functools
import http.server
import io
import os
import shutil
import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

FLAGS = ("--disable-gpu", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")
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

    def __init__(self, page):
        self._page = page
        self.problems: list[str] = []
        page.set_default_timeout(1000 * TIMEOUT)
        page.on("pageerror", lambda error: self.problems.append(str(error)))
        page.on("console", self._note)

    def open(self, url: str, *, size: tuple[int, int] = (512, 512)) -> "Page":
        """Go to ``url`` with a window of ``size`` pixels; returns once the document is there."""
        self._page.set_viewport_size({"width": size[0], "height": size[1]})
        self._page.goto(url)
        return self

    def evaluate(self, code: str):
        """Value of the JavaScript ``code``; a promise is awaited.  Its exception fails the test."""
        return self._page.evaluate(code)

    def wait(self, code: str) -> None:
        """Return once ``code`` is true."""
        self._page.wait_for_function(code, polling=100)

    def screenshot(self) -> np.ndarray:
        """The window's image, ``(H, W, 3)`` uint8."""
        return np.asarray(Image.open(io.BytesIO(self._page.screenshot())).convert("RGB"))

    def _note(self, message) -> None:
        quiet = "GL Driver Message (OpenGL, Performance"  # reading an image back waits for the software renderer
        if message.type in ("error", "warning", "assert") and quiet not in message.text:
            self.problems.append(f"{message.text} {message.location['url']}")


def pixels(data: str) -> np.ndarray:
    """``(H, W, 4)`` uint8 of a PNG in base64, also of a data URL."""
    return np.asarray(Image.open(io.BytesIO(base64.b64decode(data.rpartition(",")[2]))).convert("RGBA"))


@contextlib.contextmanager
def chromium() -> Iterator[Page]:
    """A page of a fresh browser, which ends with the block."""
    from playwright.sync_api import sync_playwright

    program = find_chromium()
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=program, args=list(FLAGS))
        try:
            yield Page(browser.new_page())
        finally:
            browser.close()


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
