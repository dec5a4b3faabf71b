"""The arbiter's model of a system: fault tree, gates, mechanisms, orders."""
