"""Griffe extension: docstrings as Markdown.

References, as :func:`~a.b`, become code, examples (``>>>``) code blocks; a bracket begins no link.
"""

import re

import griffe

ROLE = re.compile(r":(?:func|class|meth|mod|attr|data):`~?([^`]+)`")
CODE = re.compile(r"(^```.*?^```|^ {4}[^\n]*|``[^\n]*?``|`[^`]*`)", re.MULTILINE | re.DOTALL)
EXAMPLE = re.compile(r"(?:^(?:>>>|\.\.\.) [^\n]*(?:\n|\Z))+", re.MULTILINE)
PROMPT = re.compile(r"^(?:>>>|\.\.\.) ", re.MULTILINE)


def markdown(text: str) -> str:
    text = EXAMPLE.sub(lambda example: f"```python\n{PROMPT.sub('', example[0]).rstrip()}\n```\n", text)
    parts = CODE.split(ROLE.sub(r"`\1`", text))
    return "".join(part if k % 2 else part.replace("[", r"\[") for k, part in enumerate(parts))


class Roles(griffe.Extension):
    def on_object(self, *, obj: griffe.Object, **_) -> None:
        if obj.docstring:
            obj.docstring.value = markdown(obj.docstring.value)
