"""System specifications: their tables, what is checked before anything runs, time budgets."""
