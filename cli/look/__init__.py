"""Commands that look at a run: top, topic, metrics, live viewers."""
