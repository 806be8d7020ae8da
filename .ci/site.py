"""Hook of mkdocs: pages from the files of the root, and links that lead to the site's own pages.

A link stands in the repository as it must be there.  Here one to a file of the root becomes its page, and one to code,
which is not on the site, becomes its text.
"""

import os
import re
from pathlib import Path, PurePosixPath

from mkdocs.structure.files import File

ROOT = Path(__file__).parents[1]
PAGES = {"README.md": "index.md", "CHANGELOG.md": "changelog.md", "CONTRIBUTING.md": "contributing.md"}
LINK = re.compile(r"(!?)\[([^\]]*)\]\(([^)#\s]*)(#[^)]*)?\)")
CODE = re.compile(r"(^```.*?^```|`[^`\n]*`)", re.MULTILINE | re.DOTALL)


def on_files(files, config):
    for name, page in PAGES.items():
        files.append(File.generated(config, page, content=(ROOT / name).read_text()))
    return files


def on_page_markdown(markdown, page, config, files):
    """``markdown`` with its links made those of the site, code apart."""
    name = next((k for k, v in PAGES.items() if v == page.file.src_uri), None)
    source = PurePosixPath(name or f"docs/{page.file.src_uri}")
    here = os.path.dirname(page.file.src_uri)

    def link(found):
        mark, text, target, anchor = found.groups()
        if not target or "://" in target:
            return found[0]
        path = os.path.normpath(source.parent / target)
        if path in PAGES:
            path = f"docs/{PAGES[path]}"
        elif (ROOT / path).is_dir() and (ROOT / path / "README.md").exists():
            path = f"{path}/README.md"
        if not path.startswith("docs/"):
            return text
        return f"{mark}[{text}]({os.path.relpath(path.removeprefix('docs/'), here or '.')}{anchor or ''})"

    return "".join(part if k % 2 else LINK.sub(link, part) for k, part in enumerate(CODE.split(markdown)))
