"""A robot in a warehouse whose navigation is three ROS 2 nodes that somebody else wrote."""
