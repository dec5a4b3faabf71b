"""The arbiter, from reports to commands, and its memory."""
