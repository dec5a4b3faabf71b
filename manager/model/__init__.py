"""Fault trees, gates, mechanisms and orders: the words in which a system is described."""
