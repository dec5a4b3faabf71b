"""Reads a file up to a size.

Nothing here knows a format. A file is read only as far as it may be long, so that neither a huge
one nor a device without end fills the memory.
"""

from __future__ import annotations

from pathlib import Path


class FileError(ValueError):
    """Content that is refused. The text says why; which file it is, the caller knows."""


def read_bytes(path: Path, most: int) -> bytes:
    """Return the content of a file of at most so many bytes.

    Raises:
        FileError: it is longer.
        OSError: it cannot be read.
    """
    with path.open("rb") as file:
        data = file.read(most + 1)
    check_size(data, most)
    return data


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


def check_size(data: bytes | str, most: int) -> None:
    """Refuse content that is longer than it may be.

    Raises:
        FileError: it is.
    """
    if len(data) > most:
        size = f"{most >> 20} MB" if most >= 1 << 20 else f"{most >> 10} kB"
        raise FileError(f"longer than {size}, the most that is read")
