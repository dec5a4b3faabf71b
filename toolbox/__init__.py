"""`rampart`, the toolbox: looks at a running system, disturbs it, and asks the arbiter."""
