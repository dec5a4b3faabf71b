"""Reads a file up to a size, and makes one plain line of what has to be said about it.

Nothing here knows a format. A file is read only as far as it may be long, so that neither a huge
one nor a device without end fills the memory.
"""

from __future__ import annotations

from pathlib import Path

MAX_LINE = 600
"""Characters of a message; a value in it may be as long as the file."""


_PART_BYTES = 1 << 18


class FileError(ValueError):
    """Content that is refused. The text says why; which file it is, the caller knows."""


def read_bytes(path: Path, most: int) -> bytes:
    """Return the content of a file of at most so many bytes.

    Raises:
        FileError: it is longer.
        OSError: it cannot be read.
    """
    data = bytearray()
    with path.open("rb") as file:
        while len(data) <= most and (part := file.read(_PART_BYTES)):  # no more memory than needed
            data += part
    check_size(data, most)
    return bytes(data)


def read_text(path: Path, most: int) -> str:
    """Return the text in a file of at most so many bytes.

    Raises:
        FileError: it is longer, or not UTF-8.
        OSError: it cannot be read.
    """
    try:
        return read_bytes(path, most).decode("utf-8")
    except UnicodeDecodeError:
        raise FileError("not UTF-8 text") from None


def check_size(data: bytes | bytearray | str, most: int) -> None:
    """Refuse content that is longer than it may be.

    Raises:
        FileError: it is.
    """
    if len(data) > most:
        size = f"{most >> 20} MB" if most >= 1 << 20 else f"{most >> 10} kB"
        raise FileError(f"longer than {size}, the most that is read")


def plain_line(text: str) -> str:
    """Return a text as one line of bounded length in which nothing steers a terminal.

    White space becomes a blank; what cannot be printed is shown as its escape sequence.
    """
    line = " ".join(text[:4 * MAX_LINE].split())
    shown = "".join(c if c.isprintable() else ascii(c)[1:-1] for c in line)
    if len(shown) <= MAX_LINE and len(text) <= 4 * MAX_LINE:
        return shown
    return f"{shown[:MAX_LINE // 2]} ... {shown[-MAX_LINE // 4:]}"


def shown(value: object, most: int = 60) -> str:
    """Return a value of a file for a message, cut to a length."""
    try:
        text = repr(value)
    except (ValueError, RecursionError):  # an integer of thousands of digits; nesting
        return "a value too large to show"
    return text if len(text) <= most else f"{text[:most - 3]}..."
