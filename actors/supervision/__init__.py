"""Processes: starting, watching, killing and restarting them, and finding them from outside."""
