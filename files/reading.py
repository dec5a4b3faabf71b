"""Reads files of a limited size, so that no huge file or endless device fills the memory."""

from __future__ import annotations

from pathlib import Path


class FileError(ValueError):
    """Content is refused. The text is the reason; the caller adds the file."""


def read_bytes(path: Path, most: int) -> bytes:
    """Return the content of a file of at most `most` bytes.

    Raises:
        FileError: The file is longer.
        OSError: The file cannot be read.
    """
    with path.open("rb") as file:
        data = file.read(most + 1)
    check_size(data, most)
    return data


def read_text(path: Path, most: int) -> str:
    """Return the text of a file of at most `most` bytes.

    Raises:
        FileError: The file is longer, or not UTF-8.
        OSError: The file cannot be read.
    """
    try:
        return read_bytes(path, most).decode("utf-8")
    except UnicodeDecodeError:
        raise FileError("not UTF-8 text") from None


def check_size(data: bytes | str, most: int) -> None:
    """Check the size of content.

    Raises:
        FileError: It is longer than `most`.
    """
    if len(data) > most:
        size = f"{most >> 20} MB" if most >= 1 << 20 else f"{most >> 10} kB"
        raise FileError(f"longer than {size}, the most that is read")
