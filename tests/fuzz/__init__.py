"""Fuzzing with Hypothesis: inputs to every decoder of data from outside, messages to every actor.

`make fuzz`, docs/contributing/tests.md.
"""
