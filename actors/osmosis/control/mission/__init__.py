"""The Mission Manager: a mission, its orders, and what of it survives a crash."""
