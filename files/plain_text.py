r"""Text of others, made fit for a terminal, a log or a line of a report.

What comes from the bus may hold anything: an escape sequence that clears the screen or retitles
the window, a line feed that forges a line, an override that shows it backwards. None of it is shown
as what it is: each character that is not printable (`str.isprintable`: controls C0 and C1,
bidirectional overrides, separators of lines, unassigned ones) is written as `\uXXXX`, which is also
how JSON writes it.
"""

from __future__ import annotations

LINE_CHARS = 600
"""Longest line, unless told otherwise."""


def printable(text: str, keep: str = "") -> str:
    r"""Return a text with all that is not printable escaped.

    Args:
        text: of anybody.
        keep: characters that are left, such as "\n" in a text that was put together of safe lines.
    """
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() or c in keep else _escaped(c) for c in text)


def one_line(text: str, chars: int = LINE_CHARS) -> str:
    """Return a text as one printable line of at most so many characters.

    White space is joined. A longer one lacks its middle: an error ends with what was expected.
    """
    line = printable(" ".join(text.split()))
    end = chars // 4
    return line if len(line) <= chars else f"{line[:chars - end - 5]} ... {line[-end:]}"


def shown(value: object, chars: int = 60) -> str:
    """Return a value for a message, as Python writes it, cut to a length."""
    try:
        text = repr(value)
    except (ValueError, RecursionError):  # an integer of thousands of digits; nesting
        return "a value too large to show"
    return text if len(text) <= chars else f"{text[:chars - 3]}..."


def _escaped(character: str) -> str:
    units = character.encode("utf-16-be", "surrogatepass")
    return r"\u" + units.hex(",", 2).replace(",", r"\u")
