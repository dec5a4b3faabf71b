"""Detection modules DM1 to DM7: pure monitors, and the thin actors that wire them to topics."""
