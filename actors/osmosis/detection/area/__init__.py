"""Detection modules that know where the robot is and where it must not be."""
