"""The detection modules of Osmosis: pure monitors, and the thin actors round them."""
