"""ROS 2 through `rmw_zenoh`: topics, services and supervision of nodes that are not ours."""
