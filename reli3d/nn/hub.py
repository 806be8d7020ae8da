"""The published checkpoint from its hub: fetched only on request, resumed, checked, converted.

Plain HTTP of the standard library.  ``HF_ENDPOINT`` names another hub, ``HF_TOKEN`` is sent to that hub and never to
where it redirects, ``HF_HUB_OFFLINE=1`` forbids the network, and proxies are those of the environment.
"""

from __future__ import annotations

import contextlib
import hashlib
import http.client
import os
import re
import shutil
import socket
import sys
import time
import urllib.error
import urllib.request
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import urljoin, urlsplit

from tqdm import tqdm

from reli3d.nn.presets import OFFICIAL, Preset
from reli3d.nn.weights import WeightsError, convert_checkpoint, official_path

REPOSITORY = "StabilityLabs/ReLi3D"
CHECKPOINT = "reli3d_final.ckpt"
ENDPOINT = "https://huggingface.co"
LICENCE = "Stability AI Community License, https://stability.ai/license"
NOTICE = (
    f"The weights of {REPOSITORY} are not part of this package: they come under the {LICENCE}; "
    "using them is accepting it."
)
TIMEOUT = 30.0  # seconds without a byte
TRIES = 4  # in a row that bring nothing new
WAIT = 2.0  # seconds before the second try; grows with each
REDIRECTS = 5
BLOCK = 1 << 20
_REDIRECT = (301, 302, 303, 307, 308)
_BROKEN = (ConnectionError, TimeoutError, http.client.HTTPException)  # a transfer that may go on at the next request


@dataclass(frozen=True)
class Remote:
    """A file on the hub."""

    url: str
    size: int  # bytes
    sha256: str | None  # None where the server does not say


def fetch_official(*, preset: Preset = OFFICIAL) -> Path:
    """The converted official weights, fetched and converted first where :func:`official_path` is not there yet.

    A ``reli3d_final.ckpt`` that a user has put beside that path is converted without the network and left alone.  What
    was fetched goes when the converted file is written, or when the checkpoint is refused; a transfer that breaks off
    leaves a ``.part`` file, from which the next call goes on.  Raises WeightsError, one line.
    """
    target = official_path()
    if target.is_file():
        return target
    print(NOTICE, file=sys.stderr)
    fetched = target.with_name(CHECKPOINT)
    if fetched.is_file():
        convert_checkpoint(fetched, target, licence=LICENCE, preset=preset)
        return target
    checkpoint = download(REPOSITORY, CHECKPOINT, target.parent)
    try:
        convert_checkpoint(checkpoint, target, licence=LICENCE, preset=preset)
    except WeightsError:
        checkpoint.unlink()
        raise
    checkpoint.unlink()
    return target


def download(repository: str, name: str, folder: Path) -> Path:
    """A file of a hub repository, whole, in ``folder``, under a name that ends in ``.part``: the caller puts it in its
    place.

    Its size and, where the hub gives it, its SHA-256 are checked.  Raises WeightsError.
    """
    if os.environ.get("HF_HUB_OFFLINE", "").strip().lower() in ("1", "on", "yes", "true"):
        raise WeightsError(name, f"HF_HUB_OFFLINE forbids to fetch it from {repository}; unset it, or give a file")
    endpoint = (os.environ.get("HF_ENDPOINT") or ENDPOINT).rstrip("/")
    link = _Link(f"{endpoint}/{repository}/resolve/main/{name}", f"{endpoint}/{repository}")
    remote = link.describe()
    part = folder / f"{name}.{remote.sha256[:16] if remote.sha256 else 'unchecked'}.part"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with open(os.open(part, os.O_RDWR | os.O_CREAT, 0o644), "r+b") as file:
            _lock(file, part)
            found = _fetched(link, remote, file, part)
    except OSError as error:
        raise WeightsError(part, f"cannot be written ({error.strerror or error})") from None
    if remote.sha256 is not None and found != remote.sha256:
        part.unlink()
        raise WeightsError(remote.url, f"expected SHA-256 {remote.sha256}, got {found}; fetch it again")
    return part


def _fetched(link: _Link, remote: Remote, file, part: Path) -> str:
    """:func:`_fill`; an error leaves ``part`` only where the next call can go on with it."""
    if remote.sha256 is None:
        file.truncate(0)  # the version of these bytes is unknown
    try:
        have, free = file.seek(0, os.SEEK_END), shutil.disk_usage(part.parent).free
        file.seek(0)
        needed = 2 * remote.size - have  # the converted file is as long
        if free < needed:
            raise WeightsError(
                part.parent,
                f"expected {needed / 1e9:.1f} GB of free space, got {free / 1e9:.1f}; set "
                "RELI3D_WEIGHTS to another folder",
            )
        return _fill(link, remote, file)
    except BaseException:
        if remote.sha256 is None or file.seek(0, os.SEEK_END) == 0:
            part.unlink()
        raise


def _fill(link: _Link, remote: Remote, file) -> str:
    """Bring ``file`` to the remote's size, from where it ends; its SHA-256."""
    digest, have = hashlib.sha256(), 0
    while (block := file.read(BLOCK)) and have + len(block) <= remote.size:
        digest.update(block)
        have += len(block)
    best, tries, problem = have, 0, ""
    name = remote.url.rsplit("/", 1)[1]
    with tqdm(
        total=remote.size, initial=have, desc=name, unit="B", unit_scale=True, file=sys.stderr, disable=None
    ) as bar:
        while have < remote.size:
            if tries == TRIES:
                raise WeightsError(remote.url, f"ended after {best} of {remote.size} bytes{problem}; run it again")
            if tries:
                time.sleep(WAIT * tries)
            problem = ""
            try:
                with contextlib.closing(link.body(remote, have)) as response:
                    if response.status == 200 and have:  # a server without ranges starts again
                        digest, have = hashlib.sha256(), 0
                    file.seek(have)
                    file.truncate()
                    while have < remote.size and (block := response.read(min(BLOCK, remote.size - have))):
                        file.write(block)
                        digest.update(block)
                        have += len(block)
                        bar.n = have
                        bar.update(0)
            except _BROKEN as error:
                problem = f" ({_reason(error)})"
            tries = 0 if have > best else tries + 1
            best = max(best, have)
    file.truncate(remote.size)
    return digest.hexdigest()


def _lock(file, part: Path) -> None:
    try:
        import fcntl
    except ImportError:  # not on Windows; a mixed-up file is caught by its hash
        return
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        raise WeightsError(part, "another process is fetching it; wait for it") from None


class _NoRedirect(urllib.request.HTTPRedirectHandler):
    def redirect_request(self, *_):
        return None  # followed by hand: the token stays with the hub, and the hub's own answer has size and hash


class _Link:
    """One file of the hub."""

    def __init__(self, url: str, page: str):
        if urlsplit(url).scheme not in ("http", "https") or not urlsplit(url).netloc:
            raise WeightsError("HF_ENDPOINT", f"expected an address with http or https, got {url}; correct it")
        self.url, self.page = url, page
        self.token = os.environ.get("HF_TOKEN", "").strip()
        if not re.fullmatch(r"[!-~]*", self.token):
            raise WeightsError("HF_TOKEN", "expected a token of printable characters; copy it again")
        self.opener = urllib.request.build_opener(_NoRedirect)

    def describe(self) -> Remote:
        """Size and hash, from the first answer that has them."""
        with contextlib.closing(self._ask("HEAD", {})) as response:
            headers = response.headers
        size = headers.get("X-Linked-Size") or headers.get("Content-Length") or ""
        if not size.isdigit() or int(size) == 0:
            raise WeightsError(self.url, f"expected the file's size from the server, got {size or 'none'}")
        tag = (headers.get("X-Linked-ETag") or headers.get("ETag") or "").removeprefix("W/").strip('"').lower()
        return Remote(self.url, int(size), tag if re.fullmatch("[0-9a-f]{64}", tag) else None)

    def body(self, remote: Remote, start: int):
        """The file from byte ``start``, or from 0 if the status is 200."""
        response = self._ask("GET", {"Range": f"bytes={start}-"} if start else {})
        if response.status == 206:
            place, whole = f"bytes {start}-{remote.size - 1}/{remote.size}", response.headers.get("Content-Range", "")
            if not start or whole.strip().lower() != place:
                raise WeightsError(self.url, f"expected {place}, got {whole or 'no Content-Range'}; try again later")
        elif response.headers.get("Content-Length", str(remote.size)) != str(remote.size):
            got = response.headers["Content-Length"]
            raise WeightsError(self.url, f"expected {remote.size} bytes, got {got}: cut off at the server")
        return response

    def _ask(self, method: str, headers: dict[str, str]):
        """The answer after redirects; for HEAD the first one that has a size or hash.  Raises WeightsError."""
        url = self.url
        for _ in range(REDIRECTS + 1):
            request = urllib.request.Request(url, method=method, headers={"User-Agent": "reli3d", **headers})
            if self.token and _origin(url) == _origin(self.url):
                request.add_unredirected_header("Authorization", f"Bearer {self.token}")
            try:
                response = self.opener.open(request, timeout=TIMEOUT)
            except urllib.error.HTTPError as error:
                response = error
            except (OSError, ValueError, http.client.HTTPException) as error:
                raise WeightsError(self.url, f"cannot be fetched ({_reason(error)}); {_advice(error)}") from None
            answered = method == "HEAD" and (
                response.headers.get("X-Linked-Size") or response.headers.get("X-Linked-ETag")
            )
            if response.status not in _REDIRECT or answered:
                if response.status >= 400:
                    response.close()
                    raise WeightsError(self.url, self._refusal(response.status))
                return response
            url = urljoin(url, response.headers.get("Location", ""))
            response.close()
            if urlsplit(url).scheme not in ("https", _origin(self.url)[0]):  # never to a file, nor out of TLS
                raise WeightsError(self.url, f"redirects to {urlsplit(url).scheme or 'nowhere'}, which is not followed")
        raise WeightsError(self.url, f"redirects more than {REDIRECTS} times; check HF_ENDPOINT")

    def _refusal(self, status: int) -> str:
        if status in (401, 403):
            token = "does not accept the token of HF_TOKEN" if self.token else "asks for a token"
            return f"{token} ({status}); accept the licence at {self.page} and set HF_TOKEN to a token of that account"
        if status == 404:
            return "there is no such file (404); check HF_ENDPOINT"
        if status == 407:
            return "the proxy asks for a name and password (407); check HTTPS_PROXY"
        if status == 429:
            return "too many requests (429); wait some minutes"
        return f"the server answered {status}; try again later"


def _origin(url: str) -> tuple[str, str]:
    return urlsplit(url).scheme, urlsplit(url).netloc


def _reason(error: BaseException) -> str:
    reason = getattr(error, "reason", None) or error
    if isinstance(reason, TimeoutError):
        return f"no answer within {TIMEOUT:g} s"
    return " ".join(str(getattr(reason, "strerror", None) or reason).split())[:160] or type(reason).__name__


def _advice(error: BaseException) -> str:
    reason = getattr(error, "reason", None) or error
    if "tunnel" in str(reason).lower() or "proxy" in str(reason).lower():
        return "check HTTPS_PROXY"
    return "check the network and HF_ENDPOINT" if isinstance(reason, socket.gaierror) else "check the network"
