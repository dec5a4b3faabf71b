"""While a program loads, ctrl-C ends it at once, and the garbage collector rests.

`KeyboardInterrupt` could be raised inside an import, which may swallow it. As there is nothing to
clean up yet, the process just ends and prints nothing. Imports leave almost no garbage, and the
search for it takes a seventh of the time of a start.
"""

from __future__ import annotations

import gc
import os
import signal
import threading
from typing import Any

EXIT_INTERRUPTED = 1


def begin() -> None:
    """Let SIGINT end this process, unless it is ignored or has another handler."""
    gc.disable()
    _change(signal.default_int_handler, _end)


def end() -> None:
    """Let SIGINT raise `KeyboardInterrupt` again, and exempt what is loaded from collections."""
    _change(_end, signal.default_int_handler)
    gc.freeze()
    gc.enable()


def _end(_number: int, _frame: Any) -> None:
    os._exit(EXIT_INTERRUPTED)


def _change(old: Any, new: Any) -> None:
    if threading.current_thread() is threading.main_thread() and (
            signal.getsignal(signal.SIGINT) is old):
        signal.signal(signal.SIGINT, new)
