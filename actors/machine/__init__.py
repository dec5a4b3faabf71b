"""Processes of this machine, as the kernel shows them."""
