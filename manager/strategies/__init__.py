"""How a set of active mechanisms becomes a set of recoveries; one file for each strategy."""
