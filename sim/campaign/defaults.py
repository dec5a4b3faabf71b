"""What the command line needs to know of campaigns before any of them is loaded."""

PATIENCE_S = 40.0
"""Simulated seconds without progress after which a campaign's run is over."""

SEEDS = 20
"""Of the runs of a sample, unless it is asked for more: those of one seed share their beginning."""

BACKENDS = ("loky", "dask", "ray")
"""loky: processes on this machine. The others: an existing cluster."""
