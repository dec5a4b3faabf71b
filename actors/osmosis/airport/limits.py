"""How large an airport's file and what it asks for may be: far above real ones."""

from __future__ import annotations

MAX_FILE_BYTES = 4 << 20
"""Of an airport's file."""

MAX_LIGHTS = 100_000
"""Of all rows together; a row of a few characters asks for any number."""

MAX_NUMBER = 1e6
"""Of any number in an airport's file: 1,000 km from the origin, 1,000,000 cd, eleven days."""

MAX_NAME = 200
"""Characters of a name."""

MAX_WARNINGS = 50
"""Shown of what is tolerated in a foreign file."""
