"""Formatting of ``--help`` and preprocessing of arguments."""

import argparse
import sys
from collections.abc import Sequence


class Defaults(argparse.HelpFormatter):
    """Appends the default of an option to its help unless the help mentions it."""

    def _get_help_string(self, action: argparse.Action) -> str | None:
        silent = action.default is None or action.default is False or not action.option_strings
        if silent or action.default == argparse.SUPPRESS or "default" in (action.help or "default"):
            return action.help
        return f"{action.help} (default %(default)s)"


def joined(argv: Sequence[str] | None, option: str, values: Sequence[str]) -> list[str]:
    """The arguments with ``option value`` joined by ``=`` for ``values``, which may begin with a dash."""
    words = list(sys.argv[1:] if argv is None else argv)
    for k in range(len(words) - 2, -1, -1):
        if words[k] == option and words[k + 1] in values:
            words[k : k + 2] = [f"{option}={words[k + 1]}"]
    return words
