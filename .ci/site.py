"""Builds the site into a folder, ``python .ci/site.py site``; needs the extra ``docs``.  A warning fails.

The pages are those of ``docs`` and README, CONTRIBUTING and CHANGELOG.  Links are those of the
repository: one to a file of the root becomes its page, one to code, which is not on the site, becomes its text.  In
``reference.md`` the line ``<!-- names -->`` becomes the documentation of each of ``reli3d.__all__``.
"""

import os
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path, PurePosixPath

import reli3d

ROOT = Path(__file__).resolve().parents[1]
PAGES = {"README.md": "index.md", "CHANGELOG.md": "changelog.md", "CONTRIBUTING.md": "contributing.md"}
LINK = re.compile(r"(!?)\[([^\]]*)\]\(([^)#\s]*)(#[^)]*)?\)")
CODE = re.compile(r"(^```.*?^```|`[^`\n]*`)", re.MULTILINE | re.DOTALL)


def linked(text: str, source: str, page: str) -> str:
    """``text`` of the file ``source`` of the repository with its links made those of ``page``, except in code."""

    def link(found: re.Match) -> str:
        mark, words, target, anchor = found.groups()
        if not target or "://" in target:
            return found[0]
        path = os.path.normpath(PurePosixPath(source).parent / target)
        if path in PAGES:
            path = f"docs/{PAGES[path]}"
        elif (ROOT / path).is_dir() and (ROOT / path / "README.md").exists():
            path = f"{path}/README.md"
        if not path.startswith("docs/"):
            return words
        path = os.path.relpath(path.removeprefix("docs/"), os.path.dirname(page) or ".")
        return f"{mark}[{words}]({path}{anchor or ''})"

    return "".join(part if k % 2 else LINK.sub(link, part) for k, part in enumerate(CODE.split(text)))


def reference() -> str:
    """A section for each public name, which mkdocstrings fills from its docstring."""
    sections = []
    for name in (name for name in reli3d.__all__ if name != "__version__"):
        home = getattr(reli3d, name).__module__
        sections.append(f"::: {home}.{name}\n")
    return "\n".join(sections)


def prepare(folder: Path) -> None:
    """Write the configuration and all pages into ``folder``; raises ValueError for a page that is not in the nav."""
    shutil.copytree(ROOT / "docs", folder / "docs")
    pages = {f"docs/{path.relative_to(ROOT / 'docs').as_posix()}" for path in (ROOT / "docs").rglob("*.md")}
    for source, page in [*PAGES.items(), *((p, p.removeprefix("docs/")) for p in sorted(pages))]:
        text = linked((ROOT / source).read_text(), source, page)
        (folder / "docs" / page).write_text(text.replace("<!-- names -->", reference()))
    config = (ROOT / "mkdocs.yml").read_text()
    absent = sorted(p for p in pages if p.removeprefix("docs/") not in config)
    if absent:
        raise ValueError(f"mkdocs.yml: expected every page in nav, got none of {', '.join(absent)}")
    (folder / "mkdocs.yml").write_text(config)
    shutil.copytree(ROOT / ".ci", folder / ".ci")


def main(output: str) -> int:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        prepare(folder)
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])}
        command = [sys.executable, "-m", "zensical", "build", "--strict"]
        done = subprocess.run(command, cwd=folder, env=environment)
        if done.returncode == 0:
            shutil.copytree(folder / "site", output, dirs_exist_ok=True)
        return done.returncode


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]))
