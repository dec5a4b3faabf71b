"""The commands `rampart` and `kill-node`, and their common parts."""

import os

# Before numpy is imported: its libraries use one thread. The computations here are small, and a
# process with one thread can be forked (see `Launcher.begin`).
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

if __name__ != "rampart.cli":
    raise ImportError("import it as rampart.cli: everything of Rampart has this one name")
