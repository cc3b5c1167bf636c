"""Outside the bus: messages to people, to the ground station, to ROS."""
