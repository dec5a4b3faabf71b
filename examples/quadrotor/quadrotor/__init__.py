"""A quadrotor of 1.5 kg that flies a round of waypoints, as a robot of one's own for Rampart."""
