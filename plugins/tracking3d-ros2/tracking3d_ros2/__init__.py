"""A ROS 2 node of tracking3d."""
