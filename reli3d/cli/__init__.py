"""The commands: arguments in, exit codes out."""

import os

if "OMP_WAIT_POLICY" not in os.environ:  # libgomp's threads busy-wait for a millisecond, which slows other processes
    os.environ.setdefault("GOMP_SPINCOUNT", "5000")
