"""How the commands tell their options."""

from __future__ import annotations

import argparse


class Defaults(argparse.HelpFormatter):
    """Adds the default of an option to its help where it has one and the help does not say it."""

    def _get_help_string(self, action: argparse.Action) -> str | None:
        silent = action.default is None or action.default is False or not action.option_strings
        if silent or action.default == argparse.SUPPRESS or "default" in (action.help or "default"):
            return action.help
        return f"{action.help} (default %(default)s)"
