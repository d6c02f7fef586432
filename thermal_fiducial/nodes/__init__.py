"""The four ROS 2 nodes: convert, one call into the core, publish."""
