"""ROS 2 through `rmw_zenoh`: hearing, commanding and guarding nodes that are not ours."""
