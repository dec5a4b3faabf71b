"""Nodes in any language: an actor that runs a command, and what it holds of its program."""
