#!/usr/bin/env python3
"""Start the robot: build the system from its spec, run a mission, judge it, report on it."""

import sys

from rampart.cli.run import main

if __name__ == "__main__":
    sys.exit(main())
