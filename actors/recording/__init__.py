"""Recording: everything that was sent in a run, in one MCAP file, and the way back."""
