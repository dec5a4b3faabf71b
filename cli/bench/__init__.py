"""`rampart bench`: how fast the system is, against peers and floors measured in the same run."""
