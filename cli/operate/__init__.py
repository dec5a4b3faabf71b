"""Commands that act on a run: inject, adapt, reset, trigger."""
