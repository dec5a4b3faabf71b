"""Ctrl-C while a program loads ends it at once: an import cannot swallow it, and nothing is shown.

`KeyboardInterrupt` is raised wherever the program is, in an `except` of another module's say.
Where nothing runs yet that would have to be cleaned up, the process just ends.
"""

from __future__ import annotations

import os
import signal
import threading
from typing import Any

EXIT_INTERRUPTED = 1


def end_at_once() -> None:
    """Have SIGINT end this process from now on, unless it is ignored or handled otherwise."""
    _change(signal.default_int_handler, _end)


def raise_again() -> None:
    """Have SIGINT raise `KeyboardInterrupt` again."""
    _change(_end, signal.default_int_handler)


def _end(_number: int, _frame: Any) -> None:
    os._exit(EXIT_INTERRUPTED)


def _change(old: Any, new: Any) -> None:
    if threading.current_thread() is threading.main_thread() and (
            signal.getsignal(signal.SIGINT) is old):
        signal.signal(signal.SIGINT, new)
