"""``reli3d check``: checks the cameras and masks of object folders, without a reconstruction."""

import json
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from reli3d.cli import objects
from reli3d.cli.exit_codes import Parser, command, show_traceback
from reli3d.cli.infer import checked_items
from reli3d.cli.options import add_reading

if TYPE_CHECKING:
    from reli3d.pipeline import FolderOptions

SUSPECT = 3  # exit code for implausible cameras or masks


def parser() -> Parser:
    p = Parser(
        prog="reli3d check",
        description="Check the cameras and masks of object folders: print one line per view and a verdict, and draw "
        "the rig with the visual hull.",
        epilog="Exit code: 0 plausible, 1 some folders failed, 2 invalid input, 3 cameras or masks are implausible.",
    )
    add_reading(p)
    return p


@dataclass
class Check:
    """Checks the cameras of objects: a :class:`~reli3d.cli.objects.Job`.  found: results by the name of the object."""

    reading: "FolderOptions"
    silent: bool
    found: dict[str, dict] = field(default_factory=dict)

    def run(self, folder: Path, name: str, target: Path) -> str:
        """Prints one line per view and the verdict, and draws the rig."""
        from reli3d.views.check import draw_rig, explain_cameras

        views = self.reading.read(folder, whole=True)
        lines = explain_cameras(views)
        target.mkdir(parents=True, exist_ok=True)
        draw_rig(views, target / "rig.png")
        if not self.silent:
            print(*views.notes, *lines, target / "rig.png", sep="\n")
        *lines, verdict = lines
        found = {"suspect": verdict.startswith("suspect"), "verdict": verdict, "lines": lines}
        self.found[name] = {**found, "notes": list(views.notes), "image": str(target / "rig.png")}
        return "done"


@command("reli3d check")
def main(argv: list[str] | None = None) -> int:
    args = parser().parse_args(argv)
    items = checked_items(args)
    from reli3d.pipeline import FolderOptions

    job = Check(FolderOptions(args.views, args.masks, args.remove_background), args.json)
    rows = (objects.make(job, item, lambda error: show_traceback(error, args), writes=False) for item in items)
    ended, code = objects.collect("reli3d check", rows, items, lambda row: None)
    if not code and any(found["suspect"] for found in job.found.values()):
        code = SUSPECT
    if args.json:
        entries = [asdict(row) | job.found.get(row.object, {}) for row in ended]
        print(json.dumps({"objects": entries, "exit_code": code}))
    return code
