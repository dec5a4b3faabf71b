"""Simulation: virtual time, faults, runs and campaigns, and the world of Osmosis."""

if __name__ != "rampart.sim":
    raise ImportError("import it as rampart.sim: everything of Rampart has this one name")
