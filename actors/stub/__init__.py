"""Stand-ins for modules of a system that is being specified: they live, obey, and do nothing."""
