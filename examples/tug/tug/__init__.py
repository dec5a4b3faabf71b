"""A warehouse tug: it fetches trailers from a pick-up and leaves them at a drop-off."""
