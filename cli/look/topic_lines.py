"""Messages and rates as lines of text."""

from __future__ import annotations

import argparse
import asyncio
import itertools
import math
import statistics
from typing import Any

import msgspec

from rampart.cli.output import print_json, say


class Echo:
    """Prints messages, until --count of them have come.

    Attributes:
        done: set when they have come.
        seen: number of messages.
    """

    def __init__(self, options: argparse.Namespace) -> None:
        self.done, self.seen = asyncio.Event(), 0
        self._most, self._as_json = options.count or math.inf, options.json

    def show(self, data: dict[str, Any], line: str) -> None:
        """Print a message as data or in a line."""
        self.seen += 1
        if self.seen >= self._most:
            self.done.set()
        if self.seen > self._most:
            return
        if self._as_json:
            print_json(data, indent=False)
        else:
            say(line)


def rate_of(times_s: list[float]) -> dict[str, Any]:
    """Return rate and spread of arrival times, as `ros2 topic hz` does."""
    gaps = [b - a for a, b in itertools.pairwise(times_s)]
    if not gaps:
        return {"rate_hz": None, "min_s": None, "max_s": None, "std_dev_s": None,
                "window": len(times_s)}
    mean = statistics.fmean(gaps)
    return {
        "rate_hz": 1 / mean if mean > 0 else None, "min_s": min(gaps), "max_s": max(gaps),
        "std_dev_s": statistics.pstdev(gaps), "window": len(times_s),
    }


def in_line(body: Any) -> str:
    """Return a message as one line of JSON, with the length of bytes instead of the bytes."""
    plain = msgspec.to_builtins(body, builtin_types=(bytes,))

    def shorten(value: Any) -> Any:
        if isinstance(value, bytes):
            return f"<{len(value)} bytes>"
        if isinstance(value, dict):
            return {k: shorten(v) for k, v in value.items()}
        if isinstance(value, (list, tuple)):
            return [shorten(v) for v in value]
        return value

    return msgspec.json.encode(shorten(plain)).decode()


def print_rate(key: str, rate: dict[str, Any]) -> None:
    """Print a result of `rate_of`."""
    if rate["rate_hz"] is None:
        say(f"{key}: one message so far")
        return
    say(f"{key}: average rate: {rate['rate_hz']:.3f} min: {rate['min_s']:.3f}s "
        f"max: {rate['max_s']:.3f}s std dev: {rate['std_dev_s']:.5f}s window: {rate['window']}")
