"""Detection modules of position: prohibited area and localization."""
