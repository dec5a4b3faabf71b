"""Several machines: who runs what, what time it is there, and how they come together."""
