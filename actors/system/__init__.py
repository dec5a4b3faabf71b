"""Actors and processes of a whole system, their topics, and their connections."""
