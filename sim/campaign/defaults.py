"""What the command line needs to know of campaigns before any of them is loaded."""

PATIENCE_S = 40.0
"""Simulated seconds without progress after which a campaign's run is over."""

EXACT_BELOW_M = 1.0
"""Clearances of a result are exact below this; above it they may be lower bounds."""

BACKENDS = ("loky", "dask", "ray")
"""loky: processes on this machine. The others: an existing cluster."""
