#!/usr/bin/env python3
"""Start a system from this checkout, as `rampart run` does; reports go to its folder `reports`."""

import sys
from pathlib import Path

from rampart.files import loading

if __name__ == "__main__":
    loading.begin()
    from rampart.cli.run import main

    sys.exit(main(reports=Path(__file__).resolve().parent / "reports"))
