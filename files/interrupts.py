"""Ctrl-C while a program loads ends it at once and prints nothing.

`KeyboardInterrupt` could be raised inside an import, which may swallow it. As there is nothing to
clean up yet, the process just ends.
"""

from __future__ import annotations

import os
import signal
import threading
from typing import Any

EXIT_INTERRUPTED = 1


def end_at_once() -> None:
    """Let SIGINT end this process from now on, unless it is ignored or has another handler."""
    _change(signal.default_int_handler, _end)


def raise_again() -> None:
    """Let SIGINT raise `KeyboardInterrupt` again."""
    _change(_end, signal.default_int_handler)


def _end(_number: int, _frame: Any) -> None:
    os._exit(EXIT_INTERRUPTED)


def _change(old: Any, new: Any) -> None:
    if threading.current_thread() is threading.main_thread() and (
            signal.getsignal(signal.SIGINT) is old):
        signal.signal(signal.SIGINT, new)
