"""Faults: what can go wrong, when, and how it is brought about in a run."""
