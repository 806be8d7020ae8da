"""Signals of child processes."""

import signal


def heed_signals() -> None:
    """For ``preexec_fn``: what Ctrl-C and a closed terminal send ends the child, also under nohup and in a shell's
    background, where both are ignored.
    """
    for number in (signal.SIGINT, signal.SIGHUP, signal.SIGTERM):
        signal.signal(number, signal.SIG_DFL)
