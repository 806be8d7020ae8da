"""Headless Chromium by Playwright, and the images of its pages.

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


def show(page, url: str, *, size: tuple[int, int], ready: str) -> None:
    """Go to ``url`` with a window of ``size`` pixels; returns once the JavaScript ``ready`` is true."""
    page.set_viewport_size({"width": size[0], "height": size[1]})
    page.goto(url)
    page.wait_for_function(ready, polling=100)


def pixels(data: str) -> np.ndarray:
    """``(H, W, 4)`` uint8 of a PNG in base64, also of a data URL."""
    return np.asarray(Image.open(io.BytesIO(base64.b64decode(data.rpartition(",")[2]))).convert("RGBA"))


@contextlib.contextmanager
def chromium() -> Iterator:
    """Playwright's page of a fresh browser, which ends with the block.

    ``problems`` of the page gathers errors and warnings of its console, and exceptions.
    """
    from playwright.sync_api import sync_playwright

    program = find_chromium()
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=program, args=list(FLAGS))
        try:
            page = browser.new_page()
            page.set_default_timeout(1000 * TIMEOUT)
            page.problems = []
            page.on("pageerror", lambda error: page.problems.append(str(error)))
            page.on("console", lambda message: page.problems.extend(_problems(message)))
            yield page
        finally:
            browser.close()


def _problems(message) -> list[str]:
    quiet = "GL Driver Message (OpenGL, Performance"  # reading an image back waits for the software renderer
    wrong = message.type in ("error", "warning", "assert") and quiet not in message.text
    return [f"{message.text} {message.location['url']}"] if wrong else []


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
