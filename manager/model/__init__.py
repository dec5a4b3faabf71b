"""What a system is, to the arbiter: fault tree, gates, mechanisms, orders."""
