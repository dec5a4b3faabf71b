"""The contract of fault tolerance: topics and messages of modules, manager and supervision."""
