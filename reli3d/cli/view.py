"""``reli3d view``: the page of a reconstruction, served on this machine alone and opened in the browser."""

from __future__ import annotations

import argparse
import functools
import http.server
import sys
import webbrowser
from pathlib import Path
from urllib.parse import quote

from reli3d.cli.help_format import Defaults

PAGE = "viewer.html"


def parser() -> argparse.ArgumentParser:
    p = argparse.ArgumentParser(
        formatter_class=Defaults,
        prog="reli3d view",
        description="Show a reconstruction in the browser: orbit, relight, its maps, the photographs over it.",
        epilog="The page also opens by itself, as a file.  Its address goes to stdout; Ctrl-C ends.",
    )
    p.add_argument("folder", type=Path, help=f"what reli3d-infer wrote: the folder of {PAGE}")
    p.add_argument("--port", type=int, default=0, help="of 127.0.0.1 (default: a free one)")
    p.add_argument("--no-browser", action="store_true", help="print the address only")
    return p


class _Handler(http.server.SimpleHTTPRequestHandler):
    def log_message(self, *_) -> None:
        """Requests are not logged."""


def main(argv: list[str] | None = None) -> int:
    args = parser().parse_args(argv)
    try:
        if not (args.folder / PAGE).is_file():
            below = [str(p.parent) for p in sorted(args.folder.glob(f"*/{PAGE}"))[:3]]
            fix = f"give {' or '.join(below)}" if below else "make it with reli3d infer"
            raise ValueError(f"{args.folder}: expected a folder with {PAGE}, got none; {fix}")
        if not 0 <= args.port <= 65535:
            raise ValueError(f"--port: expected 0 to 65535, got {args.port}")
        handler = functools.partial(_Handler, directory=str(args.folder))
        server = http.server.ThreadingHTTPServer(("127.0.0.1", args.port), handler)
    except (OSError, ValueError) as error:
        print(f"reli3d view: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
    with server:
        url = f"http://127.0.0.1:{server.server_port}/{quote(PAGE)}"
        print(url, flush=True)
        if not args.no_browser:
            webbrowser.open(url)
        try:
            server.serve_forever()
        except KeyboardInterrupt:
            return 0
    return 0


if __name__ == "__main__":
    sys.exit(main())
