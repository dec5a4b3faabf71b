"""What makes a run of Osmosis a trial: faults, judge, record, report, story, the paper's tables."""
