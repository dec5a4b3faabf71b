"""What viewers of recordings get to see of Osmosis."""
