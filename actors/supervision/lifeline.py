"""The lifeline: a pipe whose only write end is in the launcher.

When the launcher ends, however it ends, the kernel closes the write end and every process of
the run reads end-of-file. A thread does the reading, so that a wedged event loop dies too. A
stopped process cannot read. Two things end it all the same:

* whichever process reads the end kills all others of the run before itself: one that is not
  stopped is enough;
* the launcher has the run in a process group of its own, and when the last process outside that
  holds it together, the launcher, is gone, the kernel sends SIGHUP and SIGCONT to the group if one
  of its members is stopped (setpgid(2), "orphaned process group"): with all of them stopped there
  is still the kernel. Not where what adopts the launcher's children is of the same session, as
  a shell that is the first process of a container.
"""

from __future__ import annotations

import os
import threading

from rampart.actors.bus.run_folder import remove
from rampart.actors.supervision.process_title import find_processes, kill


def exit_with_launcher(read_end: int, launcher: int, folder: str) -> None:
    """Start the thread that ends this process, and all of the run, when the launcher has ended."""

    def wait() -> None:
        while os.read(read_end, 1):
            pass
        kill_leftovers(launcher)
        remove(folder)
        kill(os.getpid())

    threading.Thread(target=wait, name="lifeline", daemon=True).start()


def kill_leftovers(launcher: int) -> list[int]:
    """SIGKILL all processes of a launcher's run except this one; return their pids."""
    return [process.pid for process in find_processes(launcher=launcher)
            if process.pid != os.getpid() and kill(process.pid)]
