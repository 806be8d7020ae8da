"""``reli3d view``: serves the viewer page of a reconstruction on this machine and opens it in the browser."""

import argparse
import contextlib
import functools
import http.server
import webbrowser
from pathlib import Path
from urllib.parse import quote

from reli3d.cli.exit_codes import Parser, check_range, command
from reli3d.errors import InputError

PAGE = "viewer.html"
HOSTS = ("localhost", "127.0.0.1", "[::1]")


def parser() -> argparse.ArgumentParser:
    p = Parser(
        prog="reli3d view",
        description="View a reconstruction in the browser: orbit, relight, show its maps, overlay the input images.",
        epilog="Prints the address; Ctrl-C ends.  The page can also be opened as a file.",
    )
    p.add_argument("folder", type=Path, help=f"folder written by reli3d-infer, with {PAGE}")
    p.add_argument("--port", type=int, default=0, help="port on 127.0.0.1 (default: any free port)")
    p.add_argument("--no-browser", action="store_true", help="print the address only")
    return p


class Handler(http.server.SimpleHTTPRequestHandler):
    """Serves the files of one folder to this machine only.

    Rejects requests whose ``Host`` is not the server's own address, against DNS rebinding.
    """

    def parse_request(self) -> bool:
        if not super().parse_request():
            return False
        port = self.connection.getsockname()[1]
        if self.headers.get_all("Host", []) in [[f"{name}:{port}"] for name in HOSTS]:
            return True
        self.send_error(403, "expected the address that reli3d view printed as Host")
        return False

    def log_message(self, *_) -> None:
        """Requests are not logged."""


@command("reli3d view")
def main(argv: list[str] | None = None) -> int:
    args = parser().parse_args(argv)
    if not (args.folder / PAGE).is_file():
        below = [str(p.parent) for p in sorted(args.folder.glob(f"*/{PAGE}"))[:3]]
        fix = f"give {' or '.join(below)}" if below else "make it with reli3d infer"
        raise InputError(args.folder, f"expected a folder with {PAGE}, got none; {fix}")
    check_range("port", args.port, 0, 65535)
    handler = functools.partial(Handler, directory=str(args.folder))
    try:
        server = http.server.ThreadingHTTPServer(("127.0.0.1", args.port), handler)
    except OSError as error:
        raise InputError("--port", f"expected a free one, got {args.port} ({error.strerror}); leave it out") from None
    with server, contextlib.suppress(KeyboardInterrupt):
        url = f"http://127.0.0.1:{server.server_port}/{quote(PAGE)}"
        print(url, flush=True)
        if not args.no_browser:
            webbrowser.open(url)
        server.serve_forever()
    return 0
