"""``reli3d download``: fetches and converts the published ReLi3D network."""

from reli3d.cli.exit_codes import Parser, command


def parser() -> Parser:
    return Parser(
        prog="reli3d download",
        description="Fetch the published checkpoint and convert it for --weights official; does nothing if the "
        "converted file exists.  Prints the path of the file.",
    )


@command("reli3d download")
def main(argv: list[str] | None = None) -> int:
    parser().parse_args(argv)
    from reli3d.nn import hub

    print(hub.fetch_official())
    return 0
