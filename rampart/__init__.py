"""Rampart: a fault-tolerant robot controller you can kill, node by node, while it works."""
