"""Which actor runs in which process, who talks with whom, and the topics of a whole system."""
