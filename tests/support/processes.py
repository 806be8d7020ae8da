"""Scripts in processes of their own, alone or as a group that trains together, and their signals."""

import os
import signal
import socket
import subprocess
import sys

ENVIRONMENT = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path), "OMP_NUM_THREADS": "1"}


def on_two(script, *arguments) -> None:
    """Run a script on two processes with the variables that torchrun sets."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    group = {**ENVIRONMENT, "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(port), "WORLD_SIZE": "2"}
    call = [sys.executable, script, *map(str, arguments)]
    started = [
        subprocess.Popen(call, env={**group, "RANK": str(k)}, stderr=subprocess.PIPE, text=True) for k in range(2)
    ]
    errors = [process.communicate(timeout=300)[1] for process in started]
    assert [process.returncode for process in started] == [0, 0], errors


def heed_signals() -> None:
    """For ``preexec_fn``: the child ends by Ctrl-C and a closed terminal under nohup and in the background too."""
    for number in (signal.SIGINT, signal.SIGHUP, signal.SIGTERM):
        signal.signal(number, signal.SIG_DFL)
