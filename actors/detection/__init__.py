"""What every detection module is made of, and the modules that know no robot."""
