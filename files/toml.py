"""TOML of bounded size, read with `tomllib`."""

from __future__ import annotations

import re
import tomllib
from typing import Any

from rampart.files.reading import FileError, check_size

MAX_SIZE = 1 << 19
"""Bytes of a file, characters of a text; shipped files have at most 16,000."""

MAX_KEY_PARTS = 200
"""Most parts of a dotted key; `tomllib` takes memory by the square of their number."""

_DOTTED = re.compile(rf"""(?<![\w"'-])(?:[\w"'-]++\s*+\.\s*+){{{MAX_KEY_PARTS}}}""")


def parse(text: str, most: int = MAX_SIZE) -> dict[str, Any]:
    """Return a document. A byte order mark at its beginning is skipped.

    Raises:
        FileError: The text is not TOML, or beyond the limits of this module.
    """
    check_size(text, most)
    if _DOTTED.search(text):
        raise FileError(f"a key of more than {MAX_KEY_PARTS} dotted parts")
    try:
        return tomllib.loads(text.removeprefix("\ufeff"))
    except tomllib.TOMLDecodeError as error:
        raise FileError(f"not valid TOML: {error}") from None
    except RecursionError:
        raise FileError("nested too deep") from None
    except ValueError:
        raise FileError("an integer with thousands of digits") from None
