"""The contract of fault tolerance: what detection, recovery, manager and supervision say."""
