"""Defaults of campaigns, for the command line, which does not load the rest."""

PATIENCE_S = 40.0
"""Simulated seconds without progress after which a campaign's run is over."""

SEEDS = 20
"""Default number of seeds of a sample; runs with the same seed share their beginning."""
