"""A quadrotor of 1.5 kg that flies along waypoints: an example of a robot for Rampart."""
