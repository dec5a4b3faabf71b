r"""Foreign text, made safe for a terminal, a log or a line of a report.

Text from the bus may contain an escape sequence that clears the screen, a line feed that forges a
line, or an override that reverses it. So each character that is not printable (`str.isprintable`:
controls C0 and C1, bidirectional overrides, line separators, unassigned ones) is written as
`\uXXXX`, as in JSON.
"""

from __future__ import annotations

LINE_CHARS = 600
"""Default length of the longest line."""


def printable(text: str, keep: str = "") -> str:
    r"""Return a text with all unprintable characters escaped.

    Args:
        text: Any text.
        keep: Characters that are not escaped, such as "\n" between safe lines.
    """
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() or c in keep else _escaped(c) for c in text)


def one_line(text: str, chars: int = LINE_CHARS) -> str:
    """Return a text as one printable line of limited length.

    White space is joined. The middle of a longer line is cut, because errors end with the expected
    value.
    """
    line = printable(" ".join(text.split()))
    end = chars // 4
    return line if len(line) <= chars else f"{line[:chars - end - 5]} ... {line[-end:]}"


def shown(value: object, chars: int = 60) -> str:
    """Return the repr of a value for a message, cut to a length."""
    try:
        text = repr(value)
    except (ValueError, RecursionError):  # an integer of thousands of digits; nesting
        return "a value too large to show"
    return text if len(text) <= chars else f"{text[:chars - 3]}..."


def _escaped(character: str) -> str:
    units = character.encode("utf-16-be", "surrogatepass")
    return r"\u" + units.hex(",", 2).replace(",", r"\u")
