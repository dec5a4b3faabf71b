"""The plan of a run, what can be asked of one that goes on, and the topics of its system."""
