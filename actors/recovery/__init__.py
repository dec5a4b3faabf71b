"""Base of recovery modules, and the modules that know no robot."""
