"""Nodes in any language: an actor that runs a command, and the process that keeps it."""
