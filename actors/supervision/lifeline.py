"""The lifeline: a pipe whose only write end is in the launcher.

When the launcher ends, however it ends, the kernel closes the write end and every process of
the run reads end-of-file. A thread does the reading, so that a wedged event loop dies too. A
stopped process cannot read: supervisor and spawners therefore kill whatever else is left of the
run before they go.
"""

from __future__ import annotations

import contextlib
import os
import signal
import threading
from collections.abc import Callable

from actors.supervision.process_title import find_processes


def exit_with_launcher(read_end: int, last_act: Callable[[], object] | None = None) -> None:
    """Start the thread that ends this process, after `last_act`, when the launcher has ended."""

    def wait() -> None:
        while os.read(read_end, 1):
            pass
        if last_act is not None:
            last_act()
        os.kill(os.getpid(), signal.SIGKILL)

    threading.Thread(target=wait, name="lifeline", daemon=True).start()


def kill_leftovers(launcher: int) -> list[int]:
    """SIGKILL all processes of a launcher's run except this one; return their pids."""
    killed = []
    for process in find_processes():
        if process.launcher != launcher or process.pid == os.getpid():
            continue
        with contextlib.suppress(ProcessLookupError):
            os.kill(process.pid, signal.SIGKILL)
            killed.append(process.pid)
    return killed
