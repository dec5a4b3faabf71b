"""The user's terminal: single keys without Return, and all as it was before at the end."""

from __future__ import annotations

import asyncio
import contextlib
import os
import re
import sys
import termios
import tty
from collections.abc import Callable, Iterator

_DISABLED = b"\0"
_ARROWS = {"A": "up", "B": "down", "C": "right", "D": "left"}
_KEY = re.compile(r"\x1b[\[O]([0-9;]*)([A-Za-z~])|\x1b|[^\x1b]", re.DOTALL)
_BEGUN = re.compile(r"\x1b(?:[\[O][0-9;]*)?$")
END = "end of input"


class KeyDecoder:
    """Bytes of a terminal in, names of keys out: "up", "down", "left", "right", or the character.

    Other function keys and a lone Escape are left out. Pure.
    """

    def __init__(self) -> None:
        self._rest = ""

    def feed(self, data: bytes) -> list[str]:
        """Take what was read; a sequence that is not complete waits for its rest."""
        text = self._rest + data.decode("ascii", errors="replace")
        self._rest = ""
        begun = _BEGUN.search(text)
        if begun is not None and len(begun[0]) < 16:
            text, self._rest = text[:begun.start()], begun[0]
        keys = []
        for match in _KEY.finditer(text):
            if match[2]:
                keys += [_ARROWS[match[2]]] if match[2] in _ARROWS else []
            elif match[0] != "\x1b":
                keys.append(match[0])
        return keys


@contextlib.contextmanager
def keys(pressed: Callable[[str], None]) -> Iterator[None]:
    """Have `pressed` called on the event loop for each key of standard input, `END` at its end.

    Ctrl-C stays a signal. Ctrl-Z is off, for it would leave the terminal in a mess. Without a
    terminal nothing is called.
    """
    if not sys.stdin.isatty():
        yield
        return
    loop, file, decoder = asyncio.get_running_loop(), sys.stdin.fileno(), KeyDecoder()
    before = termios.tcgetattr(file)

    def read() -> None:
        try:
            data = os.read(file, 1024)
        except OSError:  # the terminal has gone
            data = b""
        if not data:
            loop.remove_reader(file)
            pressed(END)
        for key in decoder.feed(data):
            pressed(key)

    try:
        tty.setcbreak(file)
        mode = termios.tcgetattr(file)
        mode[6][termios.VSUSP] = _DISABLED
        termios.tcsetattr(file, termios.TCSADRAIN, mode)
        loop.add_reader(file, read)
        yield
    finally:
        loop.remove_reader(file)
        with contextlib.suppress(termios.error):
            termios.tcsetattr(file, termios.TCSADRAIN, before)
