"""Runs, real and virtual, from the start to the verdict, and what is said meanwhile."""
