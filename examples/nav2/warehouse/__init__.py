"""A warehouse robot with a navigation of three foreign ROS 2 nodes."""
