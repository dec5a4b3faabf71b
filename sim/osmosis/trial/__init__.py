"""Trials of Osmosis: faults, judge, record, report, console, the paper's tables."""
