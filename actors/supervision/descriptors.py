"""How many files may be open: a process of a run holds a socket for each partner.

The supervisor and the observer have every process for a partner, and the supervisor holds each by
a descriptor besides. With too few of them nothing fails at once, and everything fails later.
"""

from __future__ import annotations

import resource

_EACH = 4
"""Descriptors of the supervisor for each process."""

_BESIDES = 40


def needed_descriptors(processes: int) -> int:
    """Return how many files a process of a run with so many processes may have to hold open."""
    return _BESIDES + _EACH * processes


def raise_descriptor_limit() -> int:
    """Raise the soft limit of this process and its children to the hard one, and return that."""
    _, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))
    return hard
