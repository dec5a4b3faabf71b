"""Recordings of everything that is sent in a run, as MCAP files: writing, reading, repair."""
