"""Recovery modules RM1 to RM5: what the FTM Manager commands when a fault was detected."""
