"""Translation between messages of ROS 2 and of the system. Pure."""
