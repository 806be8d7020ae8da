"""Environment and signals of scripts in processes of their own."""

import os
import signal
import sys

ENVIRONMENT = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path), "OMP_NUM_THREADS": "1"}


def heed_signals() -> None:
    """For ``preexec_fn``: the child ends by Ctrl-C and a closed terminal under nohup and in the background too."""
    for number in (signal.SIGINT, signal.SIGHUP, signal.SIGTERM):
        signal.signal(number, signal.SIG_DFL)
