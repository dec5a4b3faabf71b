"""Actors that only live, for tests of supervision."""

from __future__ import annotations

from actors import topics
from actors.runtime.actor import Actor


class Idler(Actor):
    """Beats its heart and does nothing else."""

    outputs = (topics.POSE,)
