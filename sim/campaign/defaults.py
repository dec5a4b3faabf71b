"""Defaults of campaigns, for the command line, which does not load the rest."""

PATIENCE_S = 40.0
"""Simulated seconds without progress after which a campaign's run is over."""
