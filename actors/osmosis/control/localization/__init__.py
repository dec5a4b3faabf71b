"""Localization: the pose from one sensor, or from four that check each other."""
