"""The detection modules of Osmosis: pure monitors and thin actors."""
