"""Strategies: from active mechanisms to recoveries. One file for each strategy."""
