"""A whole system in one process and in virtual time: loop, bus, processes, network."""
