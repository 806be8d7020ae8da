"""Griffe extension: docstrings as Markdown.  References, as :func:`~a.b`, become code; a bracket begins no link."""

import re

import griffe

ROLE = re.compile(r":(?:func|class|meth|mod|attr|data):`~?([^`]+)`")
CODE = re.compile(r"(^```.*?^```|^ {4}[^\n]*|``[^\n]*?``|`[^`]*`)", re.MULTILINE | re.DOTALL)


def markdown(text: str) -> str:
    parts = CODE.split(ROLE.sub(r"`\1`", text))
    return "".join(part if k % 2 else part.replace("[", r"\[") for k, part in enumerate(parts))


class Roles(griffe.Extension):
    def on_object(self, *, obj: griffe.Object, **_) -> None:
        if obj.docstring:
            obj.docstring.value = markdown(obj.docstring.value)
