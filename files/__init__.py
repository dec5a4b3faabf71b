"""How a file that somebody else wrote is read: bounded before any work is done."""
