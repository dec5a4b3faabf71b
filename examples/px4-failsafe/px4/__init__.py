"""The replay of PX4's failsafe tests."""
