"""TOML from strangers. `tomllib` reads it; what `tomllib` cannot stand is refused before.

Nested arrays end `tomllib` by a RecursionError, and a key of thousands of dotted parts takes it
memory by the square of their number (100 kB of it took 8 GB). Both show in the text without
parsing it: a scan that knows strings and comments counts brackets and dots.
"""

from __future__ import annotations

import re
import tomllib
from typing import Any

from rampart.files.reading import FileError, check_size

MAX_SIZE = 1 << 19
"""Bytes of a file, characters of a text; the shipped ones have 16,000 at most."""

MAX_KEY_PARTS = 6
"""Of a dotted key: `a.b.c` has three."""

MAX_KEY = 200
"""Characters of a part of a key: messages name the path to a value, so keys are copied often."""

MAX_DEPTH = 32
"""Of tables and arrays in each other."""

_TOO_DEEP = f"nested more than {MAX_DEPTH} deep"

_MARK = re.compile(r'''
      """(?:[^"\\]|\\.|"(?!""))*+(?:"{3,5}|\\?\Z)
    | \'\'\'(?:[^']|'(?!''))*+(?:'{3,5}|\Z)
    | "(?:[^"\\\n]|\\.)*+"?
    | '[^'\n]*+'?
    | \#[^\n]*+
    | [][{}.,=\n]
''', re.VERBOSE | re.DOTALL)
"""Strings and comments, which may hold anything, and all that counts outside of them. What is not
closed reaches to its end: there `tomllib` stops as well."""


def parse(text: str, most: int = MAX_SIZE) -> dict[str, Any]:
    """Return a document; a byte order mark at its beginning is no part of it.

    Raises:
        FileError: it is no TOML, or beyond the limits of this module.
    """
    check_size(text, most)
    _check_shape(text)
    try:
        document = tomllib.loads(text.removeprefix("\ufeff"))
    except tomllib.TOMLDecodeError as error:
        raise FileError(f"not valid TOML: {error}") from None
    except ValueError:
        raise FileError("an integer with thousands of digits") from None
    _check_nesting(document)
    return document


def _check_shape(text: str) -> None:
    depth = parts = 0
    for mark in _MARK.finditer(text):
        match mark[0]:
            case "[" | "{":
                depth += 1
                if depth > MAX_DEPTH:
                    raise FileError(_TOO_DEEP)
            case "]" | "}":
                depth -= 1
            case ".":
                parts += 1
                if parts >= MAX_KEY_PARTS:
                    raise FileError(f"a key of more than {MAX_KEY_PARTS} dotted parts")
            case "," | "=" | "\n":
                parts = 0


def _check_nesting(document: dict[str, Any]) -> None:
    """Check what the scan does not see: tables of dotted keys lie in each other too."""
    left: list[tuple[object, int]] = [(document, 0)]
    while left:
        value, depth = left.pop()
        if depth > MAX_DEPTH:
            raise FileError(_TOO_DEEP)
        if isinstance(value, dict):
            if any(len(key) > MAX_KEY for key in value):
                raise FileError(f"a key of more than {MAX_KEY} characters")
            left += [(member, depth + 1) for member in value.values()]
        elif isinstance(value, list):
            left += [(member, depth + 1) for member in value]
