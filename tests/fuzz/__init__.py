"""Fuzzing: every decoder of bytes that somebody else wrote, under limits of time and memory.

`targets` has one function per decoder, `mutate` makes inputs, `worker` runs them in a process of
its own, `run` is the command: `make fuzz`, docs/contributing/tests.md.
"""
