"""Commands that record a run, read recordings, and replay them."""
