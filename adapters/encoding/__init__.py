"""Messages as records and back: protobuf, CDR of ROS 2 and PX4, JSON."""
