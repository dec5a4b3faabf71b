"""The Safety Pilot: the last gate before the wheels."""
