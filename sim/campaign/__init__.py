"""Thousands of virtual runs: planned, run on all cores, kept, counted and shown."""
