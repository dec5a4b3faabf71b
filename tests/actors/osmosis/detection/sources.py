"""Whom detection modules listen to."""

from __future__ import annotations

from rampart.actors.osmosis import topics
from rampart.actors.runtime.actor import Actor


class Source(Actor):
    """Publishes commands and poses on request."""

    outputs = (topics.COMMAND, topics.POSE)
