"""The Mission Manager: a mission, its orders and its checkpoint."""
