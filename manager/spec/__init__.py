"""System specifications: their tables, the checks before a run, time budgets."""
