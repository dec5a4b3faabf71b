"""Messages of ROS 2 and of the system, each made of the other as tables say. Pure."""
